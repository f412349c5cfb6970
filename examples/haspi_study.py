"""Score real recordings with HASPI: unaided, with NAL-R, and at the level of NAL-R.

    python examples/haspi_study.py CLEAN_DIR NOISY_DIR AUDIOGRAMS.csv OUT [ITEMS]

CLEAN_DIR and NOISY_DIR contain recordings with equal names (in equal subfolders, if any), such as
those of VoiceBank-DEMAND. AUDIOGRAMS.csv contains measured ears, with the columns listener, ear,
hl_250, ... hl_8000. Each of
ITEMS utterances (12 by default) goes to the left ear of one of four listeners, with clean speech at
65 dB SPL, under three conditions: unaided, NAL-R, and the unaided signal at the output level of
NAL-R (gain), which shows the effect of amplification alone. The audio files and a manifest are
written into OUT, and the report into OUT/report.
"""

import csv
import sys
from pathlib import Path

from torch import Tensor

from compensators import NALR
from hlsim import Audiogram
from hlsim.audio import find_audio, read_audio, write_audio
from hlsim.audiogram.table import named_ear, read_audiograms
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation import haspi_report
from hlsim.progress import ProgressLine
from hlsim.report.recordings_page import write_report
from hlsim.report.verdict import verdict

SPL = 65.0
SECONDS = 3.0
LISTENERS = 4


def read_pair(clean_path: Path, noisy_path: Path) -> tuple[Tensor, Tensor, int]:
    """Read up to 3 s of clean and noisy speech, with the clean speech at 65 dB SPL.

    Both get the same gain, so that the signal-to-noise ratio does not change.

    Returns:
        Clean speech and noisy speech with shape (time,), and their sample rate in Hz.
    """
    clean, rate = read_audio(clean_path)
    noisy, _ = read_audio(noisy_path)
    samples = int(SECONDS * rate)
    clean = clean[0, :samples]
    gain = 10.0 ** ((SPL - level_spl(clean)) / 20.0)
    return clean * gain, noisy[0, :samples] * gain, rate


def name_below(folder: Path, path: Path) -> str:
    """Return the path of a file below a folder, without its extension."""
    return path.relative_to(folder).with_suffix("").as_posix()


def make_conditions(noisy: Tensor, ear: Audiogram, sample_rate: int) -> dict[str, Tensor]:
    """Make the signals of the three conditions by name. Shape: (time,) each."""
    prescribed = NALR(sample_rate=sample_rate)(noisy, ear)
    amplified = set_level(noisy, level_spl(prescribed))
    return {"unaided": noisy, "gain": amplified, "NAL-R": prescribed}


def main() -> None:
    clean_dir, noisy_dir, audiograms, out = map(Path, sys.argv[1:5])
    count = int(sys.argv[5]) if len(sys.argv) > 5 else 12
    noisy_paths = {name_below(noisy_dir, path): path for path in find_audio(noisy_dir)}
    clean_paths = find_audio(clean_dir)
    left_ears = [(row, ear) for row, ear in read_audiograms(audiograms) if named_ear(row) == "left"]
    left_ears = left_ears[:LISTENERS]
    rows = []
    for number in range(count):
        row, ear = left_ears[number % len(left_ears)]
        clean_path = clean_paths[number % len(clean_paths)]
        utterance = name_below(clean_dir, clean_path)
        clean, noisy, rate = read_pair(clean_path, noisy_paths[utterance])
        snr = float(level_spl(clean) - level_spl(noisy - clean))
        name = f"{row['listener']}/{utterance}.wav"
        for condition, signal in {"clean": clean, **make_conditions(noisy, ear, rate)}.items():
            write_audio(out / condition / name, signal, rate)
            if condition != "clean":
                rows.append(
                    {
                        "listener": row["listener"],
                        "ear": "left",
                        "condition": condition,
                        "clean": f"clean/{name}",
                        "processed": f"{condition}/{name}",
                        "snr": f"{5 * round(snr / 5)}",
                    }
                )
    with open(out / "study.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    with ProgressLine("values") as progress:
        report = haspi_report(
            manifest=out / "study.csv",
            audiograms=audiograms,
            measures=("haspi", "stoi"),
            store=out / "report" / "scores.jsonl",
            listen=3,
            jobs=1,
            progress=progress,
        )
    assert report.headline is not None
    print(verdict(report.headline))
    print(write_report(report, out / "report"))


if __name__ == "__main__":
    main()
