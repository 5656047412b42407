"""What the documentation names exists: every dotted name can be imported, every command can be parsed."""

import functools
import importlib
import pathlib
import re
import shlex
from collections.abc import Callable

import pytest
import tyro

from envs_mjx.robot import camera_files
from launch import bench, fusion, scale, sweep
from launch import paper as experiments
from mijax import evaluate, export, report, represent, serve, train, transfer
from mijax.config import Config
from mijax.config import options_of as config_options

ROOT = pathlib.Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "results").rglob("*.md"))]
NAME = re.compile(r"`((?:mijax|envs_mjx|configs|launch)(?:\.\w+)+)`")
COMMAND = re.compile(r"python -m ([\w.]+)([^\n`#|;)]*)")
LINK = re.compile(r"\]\((?!https?:)([^)#]*)(?:#([^)]+))?\)")
OPTION = re.compile(r"--(?:no-)?([a-z0-9]+\.(?:no-)?[a-z0-9-]+)")


def resolve(name: str) -> object:
    """The module, class, function or attribute of a dotted name."""
    parts = name.split(".")
    for split in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:split]))
        except ModuleNotFoundError:
            continue
        for part in parts[split:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(name)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_names_links_and_modules_of_commands_exist(page: pathlib.Path):
    text = page.read_text(encoding="utf-8")
    for name in NAME.findall(text):
        resolve(name)
    for module, _ in COMMAND.findall(text):
        assert (ROOT / f"{module.replace('.', '/')}.py").is_file(), module
    for link, anchor in LINK.findall(text):
        target = page.parent / link if link else page
        assert target.exists(), link
        if anchor:
            assert anchor in headings_of(target / "README.md" if target.is_dir() else target), f"{link}#{anchor}"


def headings_of(page: pathlib.Path) -> set[str]:
    """As links name them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", [page for page in PAGES if "results" not in page.parts],
                         ids=lambda page: str(page.relative_to(ROOT)))
def test_options_in_the_text_exist(page: pathlib.Path):
    known = {name.replace("_", "-") for name in config_options(Config())}
    for option in OPTION.findall(page.read_text(encoding="utf-8")):
        assert option.replace(".no-", ".") in known, option


def options_of(kind: type, words: list[str]) -> object:
    """As the command builds them."""
    return tyro.cli(kind, args=words)


PARSERS: dict[str, Callable[[list[str]], object]] = {
    "mijax.train": train.parse, "mijax.represent": represent.parse,
    "mijax.evaluate": functools.partial(options_of, evaluate.EvaluateOptions),
    "mijax.export": functools.partial(options_of, export.ExportOptions),
    "mijax.serve": serve.parse_arguments,
    "launch.sweep": sweep.parse,
    "mijax.report": functools.partial(options_of, report.ReportOptions),
    "mijax.transfer": functools.partial(options_of, transfer.TransferOptions),
    "launch.fusion": functools.partial(options_of, fusion.FusionOptions),
    "envs_mjx.robot.camera_files": camera_files.parse,
    "launch.paper": experiments.parse, "launch.bench": bench.parse, "launch.scale": scale.parse,
    # imported only here: brax is an extra
    "examples.brax_ppo": lambda words: options_of(importlib.import_module("examples.brax_ppo").PPOOptions, words)}


@pytest.mark.parametrize("page", [page for page in PAGES if "results" not in page.parts],
                         ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_are_accepted(page: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    """Parsed, not run. Run folders that a reader would put in stand for any that exists."""
    monkeypatch.chdir(tmp_path)
    for module, arguments in COMMAND.findall(page.read_text(encoding="utf-8")):
        words = shlex.split(arguments)
        if "--help" in words or "--resume" in words:
            continue
        PARSERS[module](words)
