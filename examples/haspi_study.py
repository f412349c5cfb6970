"""A study of real files: python examples/haspi_study.py CLEAN_DIR NOISY_DIR AUDIOGRAMS.csv OUT [ITEMS]

Clean and noisy recordings of equal names, such as those of VoiceBank-DEMAND, and a CSV file of measured ears with columns
listener, ear, hl_250, ... hl_8000. Each of ITEMS utterances (12) goes to a left ear, four listeners in turn, with clean
speech at 65 dB SPL, under three conditions: unaided, NAL-R, and the unaided signal raised to NAL-R's level (gain), which
tells what amplification alone would do. Writes the files and a manifest into OUT, and the report into OUT/report.
"""

import csv
import sys
from pathlib import Path

from compensators import NALR
from hlsim.audio import find_audio, read_audio, write_audio
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation import haspi_report
from hlsim.report.recordings import write_report

SPL, SECONDS, LISTENERS = 65.0, 3.0, 4


def main() -> None:
    clean_dir, noisy_dir, audiograms, out = map(Path, sys.argv[1:5])
    count = int(sys.argv[5]) if len(sys.argv) > 5 else 12
    noisy = {path.stem: path for path in find_audio(noisy_dir)}
    pairs = [(path, noisy[path.stem]) for path in find_audio(clean_dir)]
    ears = [(row, ear) for row, ear in read_audiograms(audiograms) if row["ear"] in ("l", "left")][
        :LISTENERS
    ]
    rows = []
    for number in range(count):
        row, ear = ears[number % len(ears)]
        clean_path, noisy_path = pairs[number % len(pairs)]
        (clean, rate), (mixed, _) = read_audio(clean_path), read_audio(noisy_path)
        end = int(SECONDS * rate)
        clean, mixed = clean[0, :end], mixed[0, :end]
        # one gain for both: the noise stays where it was
        gain_db = SPL - level_spl(clean)
        unaided = mixed * 10 ** (gain_db / 20)
        aided = NALR(sample_rate=rate)(unaided, ear)
        signals = {"unaided": unaided, "gain": set_level(unaided, level_spl(aided)), "NAL-R": aided}
        name = f"{row['listener']}-{clean_path.stem}.wav"
        snr = level_spl(clean) - level_spl(mixed - clean)
        for condition, signal in {"clean": clean * 10 ** (gain_db / 20), **signals}.items():
            (out / condition).mkdir(parents=True, exist_ok=True)
            write_audio(out / condition / name, signal, rate)
            if condition != "clean":
                row_of = {"listener": row["listener"], "ear": "left", "condition": condition}
                files = {"clean": f"clean/{name}", "processed": f"{condition}/{name}"}
                rows.append({**row_of, **files, "snr": f"{5 * round(float(snr) / 5)}"})
    with open(out / "study.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    report = haspi_report(
        manifest=out / "study.csv",
        audiograms=audiograms,
        measures=("haspi", "stoi"),
        store=out / "report" / "scores.jsonl",
        jobs=1,
        progress=lambda done, total: print(f"\r{done} of {total} values", end="", file=sys.stderr),
    )
    assert report.headline is not None
    print(report.headline.verdict())
    print(write_report(report, out / "report"))


if __name__ == "__main__":
    main()
