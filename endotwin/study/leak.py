"""No frame of a test may have been seen: neither by a twin nor by the network that is trained."""

from __future__ import annotations

from pathlib import Path

from endotwin.errors import EndotwinError, SequenceError
from endotwin.sequence import Sequence
from endotwin.sequence.fingerprints import checksum, fingerprints
from endotwin.sequence.readers import open_sequence
from endotwin.twin import Twin


class LeakError(EndotwinError):
    """A test sequence is known to what it shall judge."""


def require_unseen(
    tests: list[Sequence], real: list[Sequence], twins: dict[Path, Twin]
) -> tuple[str, list[str]]:
    """Raise LeakError where a photo or a depth map of a test was fused, fitted or is trained on.

    Compared are the folders, and the pixels of every photo and depth map, so that a copy under another name
    is found too. A twin whose sequence is gone raises SequenceError, as does a frame that cannot be read.

    Returns:
        what was compared, in words; a checksum of each test, then of each of ``real``.
    """
    known = {f"--real {sequence.path}": sequence for sequence in real}
    known |= {f"the twin {folder}": _source(folder, twin) for folder, twin in twins.items()}
    seen = {maker: fingerprints(sequence) for maker, sequence in known.items()}
    sums = []
    for test in tests:
        own = fingerprints(test)
        sums.append(checksum(test, own))
        for maker, prints in seen.items():
            common = len(set(own) & set(prints))
            if common or known[maker].path.resolve() == test.path.resolve():
                raise LeakError(
                    f"{test.path} cannot be a test: {maker} knows {common} of its photos and depth maps; "
                    "test on another sequence"
                )
    sums += [checksum(sequence, seen[f"--real {sequence.path}"]) for sequence in real]
    return (
        f"none of the photos and depth maps of {len(tests)} test sequences is among the "
        f"{len(set().union(*seen.values())):,} that the twins were made from or the networks were trained on"
    ), sums


def _source(folder: Path, twin: Twin) -> Sequence:
    """The sequence of a twin that can be rendered from, with its frames as they are on disk."""
    try:
        twin.sequence()
        return open_sequence(Path(twin.source.path), twin.source.format)
    except SequenceError as error:
        raise SequenceError(f"{folder} cannot be compared with the tests: {error}") from error
