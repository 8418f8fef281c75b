"""The README runs: its Python blocks in one namespace, its shell lines as commands, in order."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from torchtex import cli

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", README, flags=re.M | re.S)


def smaller(text: str) -> str:
    """The same at a quarter of the side: what counts here is that it runs."""
    for big, small in (("256", "64"), ("128:", "32:"), ("96:160, 32:224", "24:40, 8:56")):
        text = text.replace(big, small)
    return text


def test_readme_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for language, text in BLOCKS:
        if language == "python":
            exec(compile(smaller(text), "README.md", "exec"), names)
            continue
        assert language == "sh", f"a block of {language} is not run; say python or sh"
        for line in text.splitlines():
            command, *arguments = shlex.split(smaller(line), comments=True)
            assert command == "torchtex"
            with pytest.raises(SystemExit) as done:
                cli.main(arguments)
            assert done.value.code == 0, f"{line}\n{capsys.readouterr().err}"
    assert names["result"].texture.shape == (1, 64, 64)
    made = {path.name for path in tmp_path.iterdir()}
    assert made == {
        "gravel.png", "gravel.npz", "again.png", "mixed.png", "tile.png", "height.png",
        "gravel-height.png", "mark.png", "quilt.png", "cut.png", "seams.png", "patches.png",
        "atlas.png", "atlas.json", "wang.png", "cyclic.png", "cyclic_3x3.png", "moved.png",
        "blended.png", "hole.png", "filled.png", "turning.gif",
        "design.png", "map.png", "turned.png", "whole.png", "marbled.png", "denser.png", "vase.png",
        "wood.nrrd", "quick.png", "ring.glb", "torus.glb", "torus.png", "block.png",
    }  # fmt: skip


@pytest.mark.parametrize(
    "document", ["README.md", "docs/architecture.md", "docs/measured.md", "docs/metrics.md"]
)
def test_links_to_files_of_the_project_lead_somewhere(document: str) -> None:
    path = ROOT / document
    links = re.findall(r"\]\(([^)#\s]+)", path.read_text(encoding="utf-8"))
    for link in links:
        if "://" not in link:
            assert (path.parent / link).exists(), f"{document} links to {link}"


def test_rooms_name_every_module() -> None:
    rooms = README.split("## Rooms")[1].split("\n## ")[0]
    for module in (ROOT / "torchtex").glob("[a-z]*.py"):
        assert f"`{module.stem}`" in rooms, f"{module.stem} is not in the table of rooms"
