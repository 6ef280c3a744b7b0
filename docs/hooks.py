"""Pages of the site that are made of the program: the help of every command, and the pages beside the README."""

from __future__ import annotations

import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
BESIDE = {"security.md": "SECURITY.md", "contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}
SOURCE = "https://github.com/palpate/palpate/blob/main/"
LINK = re.compile(r"\]\((?!https?:|#)([^)#]+)(#[^)]*)?\)")
LOADED = re.compile(r'<(?!a\b)[^>]*?\b(?:src|href|action)="(?:https?:)?//[^>]*>|data-md-component="source"')


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are not in docs/."""
    for name, source in BESIDE.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=text))
    files.append(File.generated(config, "commands.md", content=_commands()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links to files of the repository lead to its pages on this site, or to the source."""
    del config, files
    place = Path(page.file.src_uri)
    folder = ROOT if place.name in BESIDE else ROOT / "docs" / place.parent

    def leading(match: re.Match[str]) -> str:
        """The link as it leads from the site."""
        target = (folder / match[1]).resolve().relative_to(ROOT).as_posix()
        own = {source: name for name, source in BESIDE.items()}.get(target, target.removeprefix("docs/"))
        if own == target:
            return f"]({SOURCE}{target}{match[2] or ''})"
        return f"]({os.path.relpath(own, place.parent)}{match[2] or ''})"

    return LINK.sub(leading, markdown)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """The page as it is; raises `PluginError` for one that loads anything from elsewhere (links are only followed)."""
    del config
    if found := LOADED.search(output):
        raise PluginError(f"{page.file.src_uri} would load something from elsewhere: {found[0]}")
    return output


def _commands() -> str:
    """A page with the help of every command."""
    os.environ["COLUMNS"] = "100"
    from palpate.cli.parser import make_parser

    parser = make_parser()
    (subparsers,) = (action.choices for action in parser._actions if isinstance(action.choices, dict))
    blocks = [f"# Help of the commands\n\n```text\n{parser.format_help()}```"]
    blocks += [f"## palpate {name}\n\n```text\n{command.format_help()}```" for name, command in subparsers.items()]
    return "\n\n".join(blocks) + "\n"
