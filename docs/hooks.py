"""Hooks of mkdocs that add pages and files from outside docs/ to the site, and adapt the links to them."""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PATTERNS = (
    "checkpoints/*/README.md",
    "examples/**/*.py",
    "examples/**/*.yaml",
    "examples/*.csv",
    "examples/integrations/*/README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add cards, examples and recipes to the site, under their paths in the repository."""
    for pattern in PATTERNS:
        for path in sorted(ROOT.glob(pattern)):
            name = path.relative_to(ROOT).as_posix()
            files.append(File(name, str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Shorten links between docs/ and the rest of the repository by one step.

    The site has the pages of docs/ at its root, so a link must neither leave nor enter that folder.
    """
    if page.file.src_uri == "CHANGELOG.md":
        page.meta["search"] = {"exclude": True}  # its entries would hide the guides
    markdown = re.sub(r"(\]\([^)#:]+)\.ipynb\b", r"\1.md", markdown)  # notebooks are shown as pages
    up = "../" * page.file.src_uri.count("/")
    if page.file.src_dir == str(ROOT):
        return markdown.replace(f"]({up}docs/", f"]({up}")
    return markdown.replace(f"](../{up}", f"]({up}")
