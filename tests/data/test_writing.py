"""Instances on disk: resumed, killed, out of space, on a cluster, in little memory, and always the same bytes."""

import errno
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from hlsim import files
from hlsim.audio import write_audio
from hlsim.audiogram import Audiogram
from hlsim.calibration import level_spl
from hlsim.data.instances import MANIFEST, Instance, Plan
from hlsim.data.plan import prepare
from hlsim.data.plan_settings import PlanSettings
from hlsim.data.writing import Recipe, write_instances
from hlsim.files import file_lock

ROOT = Path(__file__).parents[2]


def digests(folder: Path) -> dict[str, str]:
    """Of every file below a folder, by name."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def write(folder: Path, **options: Any) -> int:
    return write_instances(folder, Recipe(), **{"jobs": 1} | options)


def program(*arguments: str) -> subprocess.Popen[bytes]:
    environment = (
        os.environ
        | {
            "MALLOC_MMAP_THRESHOLD_": "1000000",  # glibc gives large pieces back at once: the peak is what is in use
            "PYTHONPATH": os.pathsep.join((str(ROOT), os.environ.get("PYTHONPATH", ""))),
            "OMP_NUM_THREADS": "1",
        }
    )
    return subprocess.Popen(
        [sys.executable, *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def test_another_plan_in_the_folder_is_another_plan(plan: Path) -> None:
    write(plan)
    before = digests(plan / "instances")
    shutil.rmtree(plan / "instances")
    settings = json.loads((plan / "plan.json").read_text())
    prepare(PlanSettings(Path(settings["root"]), seed=5), plan, jobs=1)
    write(plan)
    opened = Plan(plan)
    kept = Instance.read(opened.path(0))
    assert torch.equal(kept.thresholds, opened.thresholds(0))
    assert digests(plan / "instances") != before


def test_another_rate_in_the_folder_is_another_plan(plan: Path, voicebank: Path) -> None:
    write(plan)
    with pytest.raises(
        ValueError, match="another plan, with other settings or files; choose another --out"
    ):
        prepare(PlanSettings(voicebank, level=(55.0, 75.0), rate=22050), plan, jobs=1)
    write(plan)  # the plan that is there is still its own


def test_workers_elsewhere_are_told_whole_paths(
    plan: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(plan.parent)
    told: list[Any] = []

    def keep(task: Any, *_: Any, **__: Any) -> dict[str, str]:
        told.extend(task.args[:2])
        return {}

    monkeypatch.setattr("hlsim.data.writing.make_missing", keep)
    write_instances(plan.name, Recipe(), root="vbd")
    assert told == [str(plan), str(plan.parent / "vbd")]


@pytest.fixture
def one_thread() -> Iterator[None]:
    """As instances are written: more threads sum in another order."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def test_on_the_fly_and_on_disk_are_the_same(plan: Path, one_thread: None) -> None:
    from hlsim.data.teacher import Teacher

    said: list[tuple[int, int]] = []
    assert write(plan, progress=lambda done, total: said.append((done, total))) == 24
    assert said == [(4 * i, 24) for i in range(1, 7)]
    opened, teacher = Plan(plan), Teacher(16000)
    for index in range(24):
        stored, made = Instance.read(opened.path(index)), opened.instance(index)
        assert torch.equal(stored.clean, made.clean) and torch.equal(stored.signal, made.signal)
        assert torch.equal(stored.thresholds, made.thresholds)
        heard = teacher(made.signal[None], made.thresholds[None])[0]
        assert stored.impaired is not None
        torch.testing.assert_close(stored.impaired, heard, rtol=1e-5, atol=1e-7)


def test_what_is_there_is_kept_and_the_rest_made(plan: Path) -> None:
    write(plan)
    whole = digests(plan)
    opened = Plan(plan)
    untouched = opened.path(3).stat().st_mtime_ns
    opened.path(0).unlink()
    opened.path(5).write_bytes(
        opened.path(5).read_bytes()[:1000]
    )  # as a crash of the machine may leave it
    (opened.path(7).parent / ".00000007.safetensors.1.part").write_bytes(b"half")
    write(plan)
    assert digests(plan) == whole and opened.path(3).stat().st_mtime_ns == untouched


def test_two_do_not_write_at_once(plan: Path) -> None:
    pytest.importorskip("fcntl")
    with (
        file_lock(plan / MANIFEST),
        pytest.raises(ValueError, match="another process is writing there"),
    ):
        write(plan)
    write(plan)


@pytest.mark.slow
def test_killed_and_started_again_is_byte_for_byte_the_same(
    voicebank: Path, tmp_path: Path
) -> None:
    command = ("-m", "hlsim", "prepare", str(voicebank), "--write", "--jobs", "1", "--out")
    undisturbed = program(*command, str(tmp_path / "a"))
    out = tmp_path / "b"
    child = program(*command, str(out))
    try:
        deadline = time.monotonic() + 120.0
        while len(list(out.rglob("*.safetensors"))) < 3:
            assert child.poll() is None and time.monotonic() < deadline
            time.sleep(0.002)
        child.send_signal(signal.SIGKILL)
    finally:
        child.kill()
        child.communicate()
    assert child.returncode == -signal.SIGKILL
    assert 3 <= len(list(out.rglob("*.safetensors"))) < 24
    assert undisturbed.wait(120) == 0, undisturbed.communicate()
    undisturbed.communicate()
    prepare(PlanSettings(voicebank), out, jobs=1)
    write(out)
    assert digests(out) == digests(tmp_path / "a") and len(digests(out)) == 24 + 5


class Full:
    """A file on a disk that takes some more bytes."""

    left = 0

    def __init__(self, path: Path, mode: str) -> None:
        self.file = open(path, mode)  # noqa: SIM115

    def write(self, data: bytes) -> int:
        fits = data[: Full.left]
        Full.left -= len(fits)
        self.file.write(fits)
        if len(fits) < len(data):
            raise OSError(errno.ENOSPC, "No space left on device")
        return len(fits)

    def close(self) -> None:
        self.file.close()


def test_a_full_disk_ends_it_clearly_and_leaves_no_broken_instance(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(plan)
    whole = digests(plan)
    size = Plan(plan).path(0).stat().st_size
    for path in (plan / "instances").rglob("*"):
        if path.is_file():
            path.unlink()
    Full.left = round(2.5 * size)
    monkeypatch.setattr(files, "open", Full, raising=False)
    with pytest.raises(
        ValueError, match=r"00000002.safetensors: the disk is full; what was finished is kept"
    ):
        write(plan)
    monkeypatch.undo()
    left = digests(plan)
    assert {name: whole[name] for name in left} == left
    assert len([name for name in left if name.endswith(".safetensors")]) == 2
    write(plan)
    assert digests(plan) == whole


def test_a_device_that_is_full(tmp_path: Path) -> None:
    """The kernel's own error, which comes when the buffer is flushed."""
    with files.Whole(tmp_path / "a") as file:
        file.partial.unlink()
        file._file.close()  # type: ignore[union-attr]
        file._file = open("/dev/full", "wb")  # noqa: SIM115
        file.write(b"x")
        with pytest.raises(ValueError, match="the disk is full"):
            file.keep()
    assert list(tmp_path.iterdir()) == []


def test_another_plan_or_recipe_needs_another_folder(plan: Path, voicebank: Path) -> None:
    write(plan)
    before = digests(plan / "instances")
    with pytest.raises(
        ValueError, match="another plan, teacher or alignment; choose another --out"
    ):
        write_instances(plan, Recipe(alignment="impulse"), jobs=1)
    with pytest.raises(ValueError, match="another plan"):
        prepare(PlanSettings(voicebank, seed=1), plan, jobs=1)
    assert digests(plan / "instances") == before


def test_audio_that_went_bad_since_is_told_of_after_the_rest(plan: Path, voicebank: Path) -> None:
    bad = voicebank / "noisy_trainset_28spk_wav" / "p226_002.wav"
    good = bad.read_bytes()
    bad.write_bytes(b"gone")
    with pytest.raises(
        ValueError, match=r"1 of 6 utterances have no instances, the first clean_.*p226_002"
    ):
        write(plan)
    assert len(list(plan.rglob("*.safetensors"))) == 20
    assert "not readable as audio" in (plan / "write-faults.csv").read_text()
    bad.write_bytes(good)
    assert write(plan) == 24 and not (plan / "write-faults.csv").exists()


def fails_on_soft(signal: Tensor, ear: Audiogram, rate: int) -> Tensor:
    if float(level_spl(signal)) < 65.0:
        raise ValueError("too soft")
    return signal


def test_what_the_teacher_fails_on_is_told_by_the_name_of_its_utterance(plan: Path) -> None:
    with pytest.raises(
        ValueError, match=r"of 6 utterances have no instances, the first clean_.*: too soft"
    ):
        write_instances(plan, Recipe(reference=fails_on_soft), jobs=1)
    named = (plan / "write-faults.csv").read_text().splitlines()[1:]
    assert named and all(
        line.startswith("clean_") and line.endswith(".wav,too soft") for line in named
    )
    assert 0 < len(list(plan.rglob("*.safetensors"))) < 24


@pytest.mark.slow
def test_two_workers_of_a_dask_cluster_and_two_processes_give_the_same_bytes(
    voicebank: Path, tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed")
    plan = tmp_path / "out"
    prepare(PlanSettings(voicebank), plan, jobs=1)
    write(plan)
    whole = digests(plan)

    def forget() -> None:
        for path in [*plan.rglob("*.safetensors"), *plan.glob("*.*")]:
            path.unlink()

    forget()
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, env=environment
    ) as cluster:
        where: dict[str, Any] = {"backend": "dask", "scheduler": cluster.scheduler_address}
        prepare(PlanSettings(voicebank), plan, **where)
        assert write(plan, jobs=None, **where) == 24
    assert digests(plan) == whole
    forget()
    prepare(PlanSettings(voicebank), plan, jobs=2)
    assert write(plan, jobs=2) == 24
    assert digests(plan) == whole


PEAK = """
import resource, sys
from pathlib import Path
from hlsim.data.plan import prepare
from hlsim.data.plan_settings import PlanSettings
from hlsim.data.writing import Recipe, write_instances

for corpus in sys.argv[1:]:
    prepare(PlanSettings(Path(corpus), ears=1), corpus + "-out", jobs=1)
    write_instances(corpus + "-out", Recipe(), jobs=1)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.slow
def test_ten_times_the_files_take_no_more_memory(tmp_path: Path, pieces: list[Tensor]) -> None:
    """Peak resident memory in kB of 8 and then of 80 utterances of 0.8 to 2.4 s, in one process, for two differ by 4 %.

    Were the signals kept, it would rise by 30 MB.
    """
    corpora = [tmp_path / "8", tmp_path / "80"]
    for corpus in corpora:
        for i in range(int(corpus.name)):
            folder = corpus / f"speaker{i % 4}"
            folder.mkdir(parents=True, exist_ok=True)
            write_audio(folder / f"{i}.wav", torch.cat(pieces[: 1 + i % 3]), 16000)
    output, error = (child := program("-c", PEAK, *map(str, corpora))).communicate(timeout=600)
    assert child.returncode == 0, error.decode()
    few, many = map(int, output.split())
    assert many < 1.02 * few
