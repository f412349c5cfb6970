"""Build the listening page: export its models, and add onnxruntime-web and speech.

As a hook of mkdocs, this file adds the page to the site. Without npm, the site is built without the page.
This command writes the page with them into a folder, and as build/listen.zip for others:

    python docs/listening_page.py build/listen
    python -m http.server --directory build/listen

It needs npm, and hlsim with the extra ``docs``.
"""

import hashlib
import logging
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "listen"
CACHE = ROOT / "build" / "listening-page"

RUNTIME = "onnxruntime-web@1.30.0"
RUNTIME_FILES = ("ort.wasm.bundle.min.mjs", "ort-wasm-simd-threaded.wasm")
SIMULATOR = "neuro-msbg"
AID = "hearing-aid"
SPEECH = (
    "valid/flite-rms-01",
    "train/flite-slt-03",
    "valid/espeak-us-annie-01",
    "train/flite-awb-01",
)

WINDOW_SAMPLES = 40_960
"""Samples of a window of the simulator, as in docs/listen/windows.js."""

SERVE = (
    "Browsers do not run this page from a folder. Open a terminal in this folder, run "
    "<code>python3 -m http.server</code> (on Windows: <code>py -m http.server</code>), and open "
    '<a href="http://localhost:8000">http://localhost:8000</a>.'
)
"""Text of the page that is opened by a double click."""

HOPS = 2
"""Hops of the aid per call, 8 ms: one block of an AudioWorklet at 16 kHz."""


def on_config(config: "MkDocsConfig") -> "MkDocsConfig":
    """Drop the page from the navigation if it cannot be built."""
    missing = missing_requirement()
    if missing is not None:
        note = "%s is not installed, so the site has no page to listen (docs/listening_page.py)"
        logging.getLogger("mkdocs.hooks").info(note, missing)
        config.nav = [entry for entry in config.nav or [] if "listen/index.html" not in str(entry)]
    return config


def on_files(files: "Files", config: "MkDocsConfig") -> "Files":
    """Add the files to the site, or remove the page."""
    from mkdocs.structure.files import File

    if missing_requirement() is not None:
        for file in [file for file in files if file.src_uri.startswith("listen/")]:
            files.remove(file)
        return files
    for path in sorted(build_assets().rglob("*.*")):
        name = path.relative_to(CACHE).as_posix()
        files.append(File(name, str(CACHE), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown: str, page: "Page", config: "MkDocsConfig", files: "Files") -> str:
    """Replace links to the page by their text if there is no page."""
    if missing_requirement() is None:
        return markdown
    return re.sub(r"\[([^]]*)\]\([./]*listen/index\.html\)", r"\1", markdown)


def missing_requirement() -> str | None:
    """Return the name of a program or package that is not installed, or None."""
    if shutil.which("npm") is None:
        return "npm"
    packages = ("torch", "onnx", "onnxscript", "onnxruntime")
    return next((package for package in packages if find_spec(package) is None), None)


def build_assets() -> Path:
    """Write the files into ``CACHE``, unless they are there, and return their folder.

    Raises:
        subprocess.CalledProcessError: npm cannot download onnxruntime-web.
    """
    assets = CACHE / "listen" / "assets"
    stamp = CACHE / "stamp"
    fingerprint = _fingerprint()
    if stamp.is_file() and stamp.read_text() == fingerprint:
        return assets
    shutil.rmtree(CACHE, ignore_errors=True)
    (assets / "speech").mkdir(parents=True)
    for name in SPEECH:
        shutil.copy(ROOT / "hlsim" / "data" / "speech" / f"{name}.flac", assets / "speech")
    _download_runtime(assets)
    _export_models(assets)
    stamp.write_text(fingerprint)
    return assets


def _fingerprint() -> str:
    configs = [ROOT / "checkpoints" / name / "config.json" for name in (SIMULATOR, AID)]
    code = [*ROOT.glob("compensators/*.py"), *ROOT.glob("hlsim/neuro/*.py")]
    sources = [Path(__file__), ROOT / "hlsim" / "export.py", *configs, *sorted(code)]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


def _download_runtime(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        command = ["npm", "pack", "--silent", "--pack-destination", scratch, RUNTIME]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        (archive,) = Path(scratch).glob("*.tgz")
        with tarfile.open(archive) as package:
            for name in RUNTIME_FILES:
                content = package.extractfile(f"package/dist/{name}")
                assert content is not None
                (folder / name).write_bytes(content.read())


def _export_models(folder: Path) -> None:
    import onnxruntime

    from hlsim import load_compensator, load_pretrained
    from hlsim.calibration import NEURO_RATE
    from hlsim.export import export_aid, export_fit, export_onnx

    aid = load_compensator(AID)
    with tempfile.TemporaryDirectory() as scratch:
        seconds = WINDOW_SAMPLES / NEURO_RATE
        export_onnx(load_pretrained(SIMULATOR), Path(scratch, "simulator.onnx"), seconds=seconds)
        export_aid(aid, Path(scratch, "aid.onnx"), hops=HOPS)
        export_fit(aid, Path(scratch, "fit.onnx"))
        for path in Path(scratch).glob("*.onnx"):
            # Constants are folded here, because it would take a browser a second.
            options = onnxruntime.SessionOptions()
            options.log_severity_level = 3
            options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
            options.optimized_model_filepath = str(folder / path.name)
            onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def write_page(folder: Path) -> Path:
    """Write the page into a folder, without links to the rest of the site, and as a zip beside it.

    Returns: Path of the zip.
    """
    shutil.copytree(PAGE, folder, dirs_exist_ok=True)
    html = folder / "index.html"
    text = re.sub(r'<a href="\.\./[^>]*>[^<]*</a>\.?', "", html.read_text(encoding="utf-8"))
    text = re.sub(
        r'(<p class="care" id="unbuilt">).*?</p>', rf"\1{SERVE}</p>", text, flags=re.DOTALL
    )
    html.write_text(text, encoding="utf-8")
    shutil.copytree(build_assets(), folder / "assets", dirs_exist_ok=True)
    return Path(shutil.make_archive(str(folder), "zip", folder.parent, folder.name))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(f"usage: python {sys.argv[0]} FOLDER")
    missing = missing_requirement()
    if missing is not None:
        sys.exit(f"{missing} is not installed; install it to build the listening page")
    print(f"written: {write_page(Path(sys.argv[1]))}")
