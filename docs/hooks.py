"""What the site shows from outside docs/: cards, examples and recipes keep their places, and links to them hold."""

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
SHOWN = (
    "checkpoints/*/README.md",
    "examples/**/*.py",
    "examples/**/*.yaml",
    "examples/*.sh",
    "examples/*.csv",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds them under the paths that they have in the repository."""
    for pattern in SHOWN:
        for path in sorted(ROOT.glob(pattern)):
            name = path.relative_to(ROOT).as_posix()
            files.append(File(name, str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Docs are the root of the site and a folder of the repository: takes one step off links that leave or enter it."""
    up = "../" * page.file.src_uri.count("/")
    if page.file.src_dir == str(ROOT):
        return markdown.replace(f"]({up}docs/", f"]({up}")
    return markdown.replace(f"](../{up}", f"]({up}")
