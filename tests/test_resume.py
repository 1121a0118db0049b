"""A run that stops, is killed or fills the disk goes on, and the finished bytes do not tell."""

import errno
import gc
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import tube_twin

from endotwin.errors import OptionError, OutputError
from endotwin.run import output
from endotwin.run.exchange import exchanged
from endotwin.synth import Trajectory, Variation, make_job, synthesize
from endotwin.synth.labels import Labeller
from endotwin.synth.run import crew
from endotwin.synth.run.partial import Partial, partial_path
from endotwin.synth.run.shard import render_shard
from endotwin.twin import Twin

pytestmark = pytest.mark.slow

FRAMES = 56
LABELS = ("rgb", "depth", "mask", "flow")

KILLED = """
import os, random, signal, sys, time
sys.path.insert(0, {tests!r})
from pathlib import Path
import test_resume
from endotwin.twin import Twin

twin, out = Twin.load(Path({twin!r})), Path({out!r})
random.seed(4)
kills = datasets = 0
while kills < {kills} or not out.exists():
    if out.exists():
        out.rename(out.with_name(f"dataset-{{datasets}}"))
        datasets += 1
    child = os.fork()
    if child == 0:
        test_resume.render(twin, out)
        os._exit(0)
    deadline = time.monotonic() + (random.uniform(0, {longest}) if kills < {kills} else 60)
    ended = 0
    while not ended and time.monotonic() < deadline:
        time.sleep(0.001)
        ended, status = os.waitpid(child, os.WNOHANG)
    if not ended:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        kills += 1
    elif status:
        sys.exit("a run failed")
print(kills)
"""
"""A process that never renders itself, so that it can fork ones that do; it kills each at a random moment."""


def render(twin: Twin, out: Path | str, **options) -> None:
    """A small dataset of the twin."""
    synthesize(twin, trajectory(), out, labels=LABELS, **options)


def trajectory() -> Trajectory:
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.1, 0.9, FRAMES)])
    return Trajectory(poses, np.arange(FRAMES) / 30, "along the axis")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


@pytest.fixture(scope="module")
def twin() -> Twin:
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=3.0)))


@pytest.fixture(scope="module")
def whole(twin, tmp_path_factory) -> dict[str, bytes]:
    """The dataset of a run that nothing interrupted."""
    out = tmp_path_factory.mktemp("whole") / "dataset"
    render(twin, out)
    return contents(out)


def test_a_run_killed_30_times_at_random_moments_ends_in_the_same_bytes(twin, whole, tmp_path):
    twin.save(tmp_path / "twin")
    script = KILLED.format(
        tests=str(Path(__file__).parent),
        twin=str(tmp_path / "twin"),
        out=str(tmp_path / "dataset"),
        kills=30,
        longest=0.3,
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
    assert done.stdout == "30\n", done.stderr
    datasets = sorted(tmp_path.glob("dataset*"))
    assert datasets[0].name == "dataset" and not partial_path(tmp_path / "dataset").exists()
    for dataset in datasets:
        found = contents(dataset)
        assert found.keys() == whole.keys()
        assert [name for name in whole if found[name] != whole[name]] == []


def test_two_workers_give_the_bytes_of_one_and_die_with_the_run(twin, whole, tmp_path):
    twin.save(tmp_path / "twin")
    out, marks = tmp_path / "dataset", partial_path(tmp_path / "dataset") / "done"
    script = tmp_path / "run.py"
    script.write_text(
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from pathlib import Path\n"
        "import test_resume\n"
        "from endotwin.twin import Twin\n"
        "if __name__ == '__main__':\n"
        f"    test_resume.render(Twin.load(Path({str(tmp_path / 'twin')!r})), {str(out)!r}, workers=2)\n"
    )
    run = subprocess.Popen([sys.executable, script])
    while run.poll() is None and not (marks.is_dir() and any(marks.iterdir())):
        time.sleep(0.01)
    children = psutil.Process(run.pid).children(recursive=True) if run.poll() is None else []
    run.kill()
    run.wait()
    assert not psutil.wait_procs(children, timeout=20)[1]
    if not out.exists():
        render(twin, out)
    assert contents(out) == whole


@pytest.mark.long
def test_a_dask_cluster_of_two_workers_gives_the_same_bytes(twin, whole, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        render(twin, tmp_path / "dataset", scheduler=cluster.scheduler_address)
    assert contents(tmp_path / "dataset") == whole


def test_a_cluster_that_is_lost_is_told_and_the_run_goes_on_with_another(twin, whole, tmp_path):
    distributed = pytest.importorskip("distributed")
    options = {"threads_per_worker": 1, "dashboard_address": None, "processes": False}
    with distributed.LocalCluster(1, **options) as cluster:
        lost = {"scheduler": cluster.scheduler_address, "progress": lambda *_: cluster.close()}
        with pytest.raises(OutputError, match=r"scheduler .* lost.*the same command goes on"):
            render(twin, tmp_path / "dataset", **lost)
    render(twin, tmp_path / "dataset")
    assert contents(tmp_path / "dataset") == whole


def test_a_worker_that_lives_on_makes_no_folder_that_its_run_has_removed(twin, tmp_path):
    job = make_job(twin, trajectory(), 0, LABELS, "c3vd2", twin.camera, Variation())
    with pytest.raises(FileNotFoundError):
        render_shard(job, Labeller(job), tmp_path / "dataset.partial", 0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("address", ["foo", "tcp://", "nowhere.invalid:8786"])
def test_an_address_that_makes_no_sense_is_told_in_one_sentence(twin, tmp_path, capfd, address):
    pytest.importorskip("distributed")
    with pytest.raises(OptionError, match="no Dask scheduler answers"):
        render(twin, tmp_path / "dataset", scheduler=address)
    gc.collect()
    assert capfd.readouterr().err == "" and list(tmp_path.iterdir()) == []


def test_a_scheduler_that_does_not_answer_is_named_and_nothing_is_left(twin, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(crew, "SCHEDULER_TIMEOUT_S", 0.2)
    with pytest.raises(OptionError, match=r"tcp://127\.0\.0\.1:9"):
        render(twin, tmp_path / "dataset", scheduler="tcp://127.0.0.1:9")
    assert list(tmp_path.iterdir()) == []


class Enough(Exception):
    pass


def stop_after(shards: int):
    """Progress that raises once so many shards are done."""
    calls = []

    def progress(label: str, done: int, total: int) -> None:
        calls.append(done)
        if len(calls) == shards:
            raise Enough

    return progress


def test_a_full_disk_stops_the_run_with_one_sentence_and_it_goes_on_when_there_is_room(twin, whole, tmp_path):
    out = tmp_path / "dataset"
    with pytest.raises(Enough):
        render(twin, out, progress=stop_after(2))
    full = partial_path(out) / "data" / "0040_depth.tiff"
    full.symlink_to("/dev/full")
    with pytest.raises(OutputError, match=r"disk is full.*the same command goes on"):
        render(twin, out)
    assert not out.exists()
    full.unlink()
    render(twin, out)
    assert contents(out) == whole


def test_a_disk_that_is_full_from_the_start_leaves_nothing(twin, tmp_path, monkeypatch):
    def no_room(path: Path, content: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(Path, "write_bytes", no_room)
    with pytest.raises(OutputError, match="disk is full"):
        render(twin, tmp_path / "new" / "folder" / "dataset")
    assert list(tmp_path.iterdir()) == []


def test_a_stopped_run_counts_on_from_where_it_was(twin, whole, tmp_path):
    counted = []
    with pytest.raises(Enough) as stopped:
        render(twin, tmp_path / "dataset", progress=stop_after(2))
    assert "the same command goes on" in stopped.value.__notes__[0]
    render(twin, tmp_path / "dataset", progress=lambda label, done, total: counted.append(done))
    assert counted == [32, 48, 56]
    assert contents(tmp_path / "dataset") == whole


def test_another_command_does_not_go_on_with_an_unfinished_dataset(twin, whole, tmp_path):
    with pytest.raises(Enough):
        render(twin, tmp_path / "dataset", progress=stop_after(1))
    with pytest.raises(OutputError, match=r"dataset\.partial is an unfinished dataset of another command"):
        render(twin, tmp_path / "dataset", seed=1)
    render(twin, tmp_path / "dataset", overwrite=True)
    assert contents(tmp_path / "dataset") == whole


def test_a_dataset_that_is_replaced_keeps_what_others_put_into_it(twin, whole, tmp_path):
    out = tmp_path / "dataset"
    render(twin, out, seed=1)
    (out / "0000_extra.tiff").write_bytes(b"endotwin's no more")
    (out / "splits").mkdir()
    (out / "splits" / "0001_color.png").write_bytes(b"mine")
    (out / "0001_depth.tiff").write_bytes(b"broken")

    class Stopped(BaseException):
        pass

    def stopped(*_) -> None:
        raise Stopped

    def stopped_after_the_exchange(one: Path, other: Path) -> None:
        assert exchanged(one, other)
        raise Stopped

    places = [(output, "exchanged", stopped_after_the_exchange)] if sys.platform == "linux" else []
    for home, name, stop in [*places, (Partial, "remove", stopped)]:
        with pytest.MonkeyPatch.context() as patch, pytest.raises(Stopped):
            patch.setattr(home, name, stop)
            render(twin, out, overwrite=True)
    render(twin, out, overwrite=True)
    guests = {"0000_extra.tiff": b"endotwin's no more", "splits/0001_color.png": b"mine"}
    assert contents(out) == {**whole, **guests}


def test_a_folder_of_someone_else_is_not_taken_for_an_unfinished_dataset(twin, tmp_path):
    (tmp_path / "dataset.partial").mkdir()
    (tmp_path / "dataset.partial" / "data").write_text("precious")
    with pytest.raises(OutputError, match="no unfinished dataset"):
        render(twin, tmp_path / "dataset", overwrite=True)
    assert (tmp_path / "dataset.partial" / "data").read_text() == "precious"


def test_two_runs_do_not_work_on_one_dataset(twin, tmp_path):
    def again(label: str, done: int, total: int) -> None:
        with pytest.raises(OutputError, match="another run"):
            render(twin, tmp_path / "dataset")
        raise Enough

    with pytest.raises(Enough):
        render(twin, tmp_path / "dataset", progress=again)


def test_a_run_killed_after_the_dataset_got_its_place_is_tidied_up(twin, whole, tmp_path, monkeypatch):
    def killed(self) -> None:
        raise Enough

    with monkeypatch.context() as patch, pytest.raises(Enough):
        patch.setattr(Partial, "remove", killed)
        render(twin, tmp_path / "dataset")
    assert partial_path(tmp_path / "dataset").exists()
    render(twin, tmp_path / "dataset")
    assert not partial_path(tmp_path / "dataset").exists()
    assert contents(tmp_path / "dataset") == whole


@pytest.mark.parametrize("workers", [2, 3])
@pytest.mark.parametrize("left", [range(40), [0, 3, 4, 5, 9, 20, 21, 22, 23, 24, 25]], ids=["new", "resumed"])
def test_workers_of_any_speed_do_every_shard_once_and_mostly_the_one_after_their_last(workers, left):
    left, generator = list(left), np.random.default_rng(0)
    pending, done, at_work, followed = list(left), [], {}, 0
    for worker in range(workers):
        at_work[worker] = crew.next_shard(pending, None, at_work.values())
        pending.remove(at_work[worker])
    while pending:
        worker = int(generator.integers(workers))
        done.append(at_work.pop(worker))
        at_work[worker] = crew.next_shard(pending, done[-1], at_work.values())
        pending.remove(at_work[worker])
        followed += at_work[worker] == done[-1] + 1
    assert sorted([*done, *at_work.values()]) == left
    could = sum(number + 1 in left for number in left)
    assert followed >= could - 2 * workers
