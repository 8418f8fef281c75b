"""Flows in words."""

import doctest
from pathlib import Path

import pytest
import torch
from conftest import noise

from torchtex.flow import words
from torchtex.flow.fields import Flow, Given, Scaled, Summed, Uniform, is_periodic
from torchtex.flow.files import save_flow
from torchtex.flow.fluids import DoubleGyre, StableFluid
from torchtex.flow.formulas import Rotation, Saddle, Shear, Sink, Source, Wave
from torchtex.flow.strokes import Strokes
from torchtex.flow.vortices import Vortices, vortex_pair
from torchtex.flow.words import parse_flow, untiled


@pytest.mark.parametrize(
    ("text", "flow"),
    [
        ("uniform:0,2", Uniform((0.0, 2.0))),
        ("uniform: -1e+0 , column=2", Uniform((-1.0, 2.0))),
        ("shear:3,90,periodic", Shear(3.0, 90.0, True)),
        ("rotation:2", Rotation(2.0)),
        ("rotation:row=0.2", Rotation(2.0, (0.2, 0.5))),
        ("vortex:strength=3,radius=0.3", Vortices((3.0,), radius=0.3)),
        ("pair:periodic=no", vortex_pair()),
        ("source", Source()),
        ("source:", Source()),
        ("sink:1.5", Sink(1.5)),
        ("sink:1.5,0.2,periodic=yes", Sink(1.5, core=0.2, periodic=True)),
        ("saddle:1,30", Saddle(1.0, angle=30.0)),
        ("wave:1,2,3,4", Wave(1.0, (2.0, 3.0), 4.0)),
        ("gyre:period=10", DoubleGyre(period=10.0)),
        ("fluid:seed=3", StableFluid(seed=3)),
        ("fluid:3,periodic,resolution=32", StableFluid(3, periodic=True, resolution=32)),
        ("sink:1+rotation", Summed((Sink(1.0), Rotation()))),
        ("uniform:1e+1,2+wave", Summed((Uniform((10.0, 2.0)), Wave()))),
    ],
)
def test_words_are_the_flows_that_they_name(text: str, flow: Flow) -> None:
    assert parse_flow(text) == flow


def test_files_are_named_by_their_path(tmp_path: Path) -> None:
    fields = noise(2, 2, 5, 4)
    for suffix in (".npy", ".npz"):
        save_flow(tmp_path / f"a{suffix}", fields)
        found = parse_flow(str(tmp_path / f"a{suffix}"))
        assert isinstance(found, Given)
        assert torch.equal(found.fields, fields)
    looped = parse_flow(f"file:{tmp_path / 'a.npy'},loop")
    assert isinstance(looped, Given)
    assert looped.loop
    (tmp_path / "up.json").write_text("[[[0.9, 0.5], [0.1, 0.5]]]")
    line = ((0.9, 0.5), (0.1, 0.5))
    text = f"strokes:{tmp_path / 'up.json'},width=0.2,periodic"
    assert parse_flow(text) == Strokes((line,), width=0.2, periodic=True)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("vortexx:3", "flow='vortexx:3' names no flow; did you mean vortex?"),
        ("", "names no flow; known are uniform, shear,.* and paths that end in"),
        ("qqq", "known are uniform"),
        ("sink:1+", "speed=1\\+ must be a number"),
        ("sink:speed=fast", "speed=fast must be a number"),
        ("fluid:1.5", r"seed=1\.5 must be a whole number"),
        ("sink:sped=1", "has no argument 'sped'; known are speed, core, row, column, periodic"),
        ("sink:1,speed=2", "gives speed twice"),
        ("sink:speed=2,1", "has no place for '1'"),
        ("uniform:1,2,3", "has no place for '3'"),
        ("sink:periodic=maybe", "periodic=maybe must be yes or no"),
        ("sink:nan", "flow='sink:nan': speed=nan must be finite"),
        ("strokes", "needs file"),
        ("strokes:none.json", "file='none.json': there is no such file"),
        ("none.npy", "flow='none.npy': there is no such file"),
        ("file:none.txt", "must end in"),
        ("shear:angle=30,periodic", "must be a multiple of 90"),
    ],
)
def test_wrong_words_are_refused_in_a_sentence(text: str, says: str) -> None:
    with pytest.raises(ValueError, match=says) as error:
        parse_flow(text)
    assert "\n" not in str(error.value)


def test_every_name_of_the_docstring_is_known_and_the_other_way_round() -> None:
    doc = parse_flow.__doc__ or ""
    rows = [line.strip() for line in doc.splitlines() if line.strip().startswith("|")]
    names = {name.strip() for row in rows[2:] for name in row.split("|")[1].split(",")}
    assert names == set(words._BUILDERS)


def test_examples() -> None:
    assert doctest.testmod(words, extraglobs={"torch": torch}).failed == 0


@pytest.mark.parametrize(
    "text",
    [
        "uniform:1,2", "shear", "shear:periodic", "shear:2,90,periodic", "rotation", "vortex",
        "vortex:periodic", "pair", "pair:periodic", "source", "source:periodic", "sink",
        "sink:periodic", "saddle", "saddle:periodic", "wave", "wave:1,1,-2", "wave:1,0,1.5", "gyre",
        "gyre:periodic", "fluid", "fluid:periodic", "strokes:FILE", "strokes:FILE,periodic",
        "sink+uniform:0,1", "wave+uniform:0,1",
    ],
)  # fmt: skip
def test_periodic_flows_are_those_that_do_not_jump_at_the_edges(text: str, tmp_path: Path) -> None:
    (tmp_path / "up.json").write_text("[[[0.9, 0.5], [0.1, 0.5]], [[0.2, 0.1], [0.3, 0.9]]]")
    flow = parse_flow(text.replace("FILE", str(tmp_path / "up.json")))
    field = flow(7, 48, 64)
    jumps = []
    for axis in (1, 2):
        inside = field.diff(dim=axis).abs().amax()
        across = (field.select(axis, 0) - field.select(axis, -1)).abs().amax()
        jumps.append(bool(across > 1.2 * inside + 1e-9))
    assert is_periodic(flow) is not any(jumps)
    assert is_periodic(Scaled(flow, 2.0)) is is_periodic(flow)


def test_of_given_fields_nobody_knows() -> None:
    given = Given(torch.ones(2, 4, 5))
    assert is_periodic(given) is None
    assert is_periodic(Summed((given, Uniform((0.0, 1.0))))) is None
    assert is_periodic(Summed((given, Sink()))) is False
    assert is_periodic(lambda frame, height, width: torch.zeros(2, height, width)) is None


@pytest.mark.parametrize(
    ("text", "remedies"),
    [
        ("uniform:1,2+sink:periodic+wave:1,0,2", []),
        ("sink:periodic=no", []),
        ("sink", ["write sink:periodic"]),
        ("sink:1.5+rotation:3", ["write sink:1.5,periodic", "a vortex with periodic turns too"]),
        ("wave:1,0,1.5", ["give it whole rows and columns"]),
    ],
)
def test_flows_that_are_no_tiles_are_told_with_what_to_write(
    text: str, remedies: list[str]
) -> None:
    found = untiled(text)
    assert [sentence.partition("; ")[2] for sentence in found] == remedies
    for remedy in remedies:
        if remedy.startswith("write "):
            assert untiled(remedy[6:]) == []
