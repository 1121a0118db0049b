"""The quick half: what ``endotwin selfcheck`` runs on the user's machine."""

import json
import math
import sys
from importlib import import_module

import pytest
from endotwin.cli.main import app

from endotwin import selfcheck
from endotwin.selfcheck import GROUPS, Finding, run_checks

pytestmark = pytest.mark.slow

TWINS_BY_THE_DOZEN = ("motion", "depth", "seeds", "places", "photos")

CHECKS = [
    pytest.param(
        check,
        marks=[pytest.mark.long] if check.__name__ in TWINS_BY_THE_DOZEN else [],
        id=f"{name}-{check.__name__}",
    )
    for name in GROUPS
    for check in import_module(f"endotwin.selfcheck.{name}").CHECKS
]


@pytest.mark.filterwarnings("error::RuntimeWarning")  # as the command has it
@pytest.mark.parametrize("check", CHECKS)
def test_every_bound_is_kept(check):
    findings = list(check())
    assert findings
    assert not [finding for finding in findings if not finding.ok]
    for finding in findings:
        assert check.__doc__ and finding.case and finding.promise


def test_a_bound_is_broken_by_what_is_beyond_it_or_not_finite():
    assert Finding("most", 1.0, 1.0).ok and not Finding("most", 1.1, 1.0).ok
    assert Finding("least", 1.0, 1.0, at_least=True).ok and not Finding("least", 0.9, 1.0, at_least=True).ok
    for value in (math.nan, math.inf, -math.inf):
        assert not Finding("most", value, 1.0).ok and not Finding("least", value, 1.0, at_least=True).ok


class Two:
    """A group of checks of which one is broken and one raises."""

    @staticmethod
    def kept():
        yield Finding("kept", 1e-7, 1e-6)

    @staticmethod
    def broken():
        yield Finding("broken", 2.0, 1.0, unit="dB")

    @staticmethod
    def raises():
        raise ZeroDivisionError("by nothing")
        yield

    CHECKS = (kept, broken, raises)


@pytest.fixture
def two(monkeypatch):
    monkeypatch.setitem(sys.modules, "endotwin.selfcheck.two", Two)
    monkeypatch.setattr(selfcheck, "GROUPS", {"two": "Two"})
    monkeypatch.setattr(selfcheck, "PROCESSES", 1)


def test_a_check_that_raises_is_a_broken_bound_with_its_error(two):
    *_, (title, last) = run_checks()
    assert (title, last.ok) == ("Two", False)
    assert "ZeroDivisionError: by nothing" in last.case


def selfcheck_exit(*options: str) -> int:
    with pytest.raises(SystemExit) as exit_:
        app(["selfcheck", *options])
    return exit_.value.code or 0


def test_the_command_prints_case_bound_and_measured_and_exits_with_1_if_a_bound_is_broken(two, capsys):
    assert selfcheck_exit() == 1
    out = capsys.readouterr().out
    for words in ("kept", "≤ 1.0e-06", "1.0e-07", "≤ 1 dB", "2 dB", "broken", "1 of 3 bounds kept"):
        assert words in out


def test_the_findings_as_json(two, capsys, monkeypatch):
    monkeypatch.setattr(Two, "CHECKS", (Two.kept,))
    assert selfcheck_exit("--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found == [
        {
            "group": "Two",
            "case": "kept",
            "measured": 1e-7,
            "bound": 1e-6,
            "at_least": False,
            "unit": "",
            "ok": True,
        }
    ]
