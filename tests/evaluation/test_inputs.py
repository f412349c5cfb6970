"""What a manifest says, and what it may not."""

import os
from pathlib import Path

import pytest

from hlsim.audiogram import Audiogram
from hlsim.evaluation.previous.inputs import below_root, read_manifest

N3 = Audiogram.standard("N3")


def write(folder: Path, *lines: str, name: str = "study.csv") -> Path:
    (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8-sig")
    return folder / name


def test_rows_become_items(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "listener,ear,condition,clean,processed,snr,hl_250,hl_1000,hl_8000,note",
        "L1,l,unaided,clean/a.wav,noisy/a.wav,5,20,30,60,x",
        "L1,l,NAL-R,clean/a.wav,nalr/a.wav,5,20,30,60,x",
        "L1,Right,unaided,clean/a.wav,noisy/a.wav,5,10,20,30,x",
        "L1,l,unaided,clean/a.wav,noisy0/a.wav,0,20,30,60,x",
    )
    first, second, third = read_manifest(path, full_scale_spl=100.0)
    assert first.processed == {
        "unaided": tmp_path.resolve() / "noisy/a.wav",
        "NAL-R": tmp_path.resolve() / "nalr/a.wav",
    }
    assert (first.name, first.listener, first.ear, first.snr) == (
        "L1 left clean/a 5 dB",
        "L1",
        "left",
        5.0,
    )
    assert first.audiogram == Audiogram((20.0, 30.0, 60.0), (250.0, 1000.0, 8000.0))
    assert (first.full_scale_spl, first.spl) == (100.0, None)
    assert (second.ear, second.audiogram.levels[0]) == ("right", 10.0)
    assert (third.snr, third.clean) == (0.0, first.clean)


def test_audiograms_of_rows_of_a_file_and_of_all(tmp_path: Path) -> None:
    ears = write(
        tmp_path,
        "listener,ear,hl_250,hl_8000",
        "L1,l,10,20",
        "L1,r,30,40",
        "L2,,50,60",
        name="ears.csv",
    )
    header = "listener,ear,condition,clean,processed,audiogram"
    rows = (
        "L1,left,u,c.wav,u.wav,",
        "L1,right,u,c.wav,u.wav,",
        "L2,left,u,c.wav,u.wav,",
        "L3,,u,c.wav,u.wav,S2",
    )
    path = write(tmp_path, header, *rows)
    found = [item.audiogram.levels for item in read_manifest(path, audiograms=ears)]
    assert found == [(10.0, 20.0), (30.0, 40.0), (50.0, 60.0), Audiogram.standard("S2").levels]
    path = write(tmp_path, header, "L9,left,u,c.wav,u.wav,")
    with pytest.raises(
        ValueError, match=r"study\.csv, line 2: no audiogram of listener 'L9', ear 'left'"
    ):
        read_manifest(path, audiograms=ears)
    assert read_manifest(path, audiogram=N3)[0].audiogram == N3


def test_levels_of_rows_and_of_all(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "item,condition,clean,processed,audiogram,spl,full_scale_spl",
        "a,u,c.wav,u.wav,N3,65,",
        "b,u,c.wav,u.wav,N3,,110",
        "c,u,c.wav,u.wav,N3,,",
    )
    assert [(i.name, i.spl, i.full_scale_spl) for i in read_manifest(path, spl=70.0)] == [
        ("a", 65.0, 94.0),
        ("b", None, 110.0),
        ("c", 70.0, 94.0),
    ]


def test_what_no_row_takes_is_refused(tmp_path: Path) -> None:
    own = write(
        tmp_path, "listener,condition,clean,processed,audiogram,spl", "L1,u,c.wav,u.wav,N3,65"
    )
    ears = write(tmp_path, "listener,hl_250", "L1,10", name="ears.csv")
    for options in ({"audiogram": N3}, {"audiograms": ears}, {"spl": 70.0}):
        with pytest.raises(
            ValueError, match=rf"study\.csv: no row takes {next(iter(options))}, for each has its"
        ):
            read_manifest(own, **options)  # type: ignore[arg-type]
    some = write(tmp_path, "listener,condition,clean,processed,audiogram,spl", "L1,u,c.wav,u.wav,,")
    with pytest.raises(ValueError, match="no row takes audiogram,"):
        read_manifest(some, audiogram=N3, audiograms=ears)
    both = write(
        tmp_path,
        "condition,clean,processed,audiogram,spl",
        "u,c.wav,u.wav,N4,60",
        "v,d.wav,v.wav,,",
    )
    assert [item.spl for item in read_manifest(both, audiogram=N3, spl=70.0)] == [60.0, 70.0]


def test_root(tmp_path: Path) -> None:
    (tmp_path / "root").mkdir()
    path = write(tmp_path, "condition,clean,processed,audiogram", "u,a/../c.wav,u.wav,N3")
    item = read_manifest(path, tmp_path / "root")[0]
    assert item.clean == tmp_path.resolve() / "root" / "c.wav"
    with pytest.raises(ValueError, match="no such folder; the manifest's paths are relative to it"):
        read_manifest(path, tmp_path / "none")


@pytest.mark.parametrize("name", ["../c.wav", "a/../../c.wav", "/etc/passwd", "link/c.wav", ""])
def test_no_path_leaves_the_root(tmp_path: Path, name: str) -> None:
    root = tmp_path.resolve() / "root"
    root.mkdir()
    os.symlink(tmp_path, root / "link")
    for column, row in (("clean", f"u,{name},u.wav,N3"), ("processed", f"u,u.wav,{name},N3")):
        path = write(tmp_path, "condition,clean,processed,audiogram", row)
        with pytest.raises(
            ValueError, match=f"line 2: {column} is '.*(which leaves|a path relative to)"
        ):
            read_manifest(path, root)
    with pytest.raises(ValueError):
        below_root(root, name, "clean")


HEADER = "listener,ear,condition,clean,processed,audiogram,spl,full_scale_spl,snr"


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ((HEADER, "L1,both,u,c.wav,u.wav,N3,,,"), "line 2: ear is 'both'; allowed: left, right"),
        ((HEADER, "L1,l,,c.wav,u.wav,N3,,,"), "line 2: no condition"),
        (
            (HEADER, 'L1,l,"a\n\\input{/etc/passwd}",c.wav,u.wav,N3,,,'),
            "holds characters that do not print; allowed",
        ),
        (
            (HEADER, "L1\u202e,l,a,c.wav,u.wav,N3,,,"),
            r"'L1\\u202e.*' holds characters",
        ),
        ((HEADER, "L1,l,u,c.wav,u.wav,N9,,,"), "line 2: no standard audiogram 'N9'"),
        ((HEADER, "L1,l,u,c.wav,u.wav,N3,65,94,"), "line 2: both spl and full_scale_spl"),
        (
            (HEADER, "L1,l,u,c.wav,u.wav,N3,loud,,"),
            "line 2: spl is 'loud'; allowed: a number of dB",
        ),
        ((HEADER, "L1,l,u,c.wav,u.wav,N3,,,inf"), "line 2: snr is 'inf'"),
        ((HEADER, "L1,l,u,c.wav,u.wav,N3,,900,"), "line 2: full_scale_spl is 900"),
        (
            (HEADER, "L1,l,u,c.wav,u.wav,N3,,,", "L1,l,u,c.wav,v.wav,N3,,,"),
            "line 3: a second row of condition 'u'",
        ),
        (
            (HEADER, "L1,l,u,c.wav,u.wav,N3,,,", "L1,l,v,c.wav,v.wav,N4,,,"),
            "line 3: audiogram or level is not that of the other rows of L1 left c",
        ),
        (
            ("condition,clean,processed,hl_250,hl_1000,hl_8000", "u,c.wav,u.wav,20,30,"),
            "line 2: .*hl_8000",
        ),
        (("condition,clean,processed,HL_250,hl_8000", "u,c.wav,u.wav,20,30"), "line 2: .*'HL_250'"),
        (
            (HEADER, "", "L1,l,u,c.wav,u.wav,N3,,,", "", "L1,both,u,c.wav,u.wav,N3,,,"),
            "study.csv, line 5: ear is 'both'",
        ),
        (("condition,clean", "u,c.wav"), "no column processed; needs condition, clean, processed"),
        ((HEADER,), "no rows; needs a header"),
    ],
)
def test_bad_rows_are_named(tmp_path: Path, lines: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        read_manifest(write(tmp_path, *lines))
    assert "\n" not in str(error.value) and "study.csv" in str(error.value)


def test_bad_files(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot read the manifest"):
        read_manifest(tmp_path / "none.csv")
    path = write(tmp_path, HEADER, "L1,l,u,c.wav,u.wav,,,,")
    for rows, message in (
        (
            ("listener,ear,hl_250", "L1,l,10", "", "L1,left,20"),
            "ears.csv, line 4: a second row of listener L1",
        ),
        (("ear,hl_250", "l,10"), "ears.csv, line 2: no listener"),
        (("listener,ear,hl_250", "L1,x,10"), "ears.csv, line 2: ear is 'x'"),
    ):
        with pytest.raises(ValueError, match=message):
            read_manifest(path, audiograms=write(tmp_path, *rows, name="ears.csv"))
