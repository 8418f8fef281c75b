"""Optional packages: imported, or named with the extra that brings them."""

import sys

import pytest

from torchtex.extras import EXTRAS, installed, needed


def test_a_package_that_is_there_is_handed_over() -> None:
    pytest.importorskip("yaml", reason="PyYAML is not installed")
    assert needed("yaml", "recipe").safe_load("[1, 2]") == [1, 2]


@pytest.mark.parametrize(
    ("extra", "module", "package"),
    [(extra, module, name) for extra, names in EXTRAS.items() for module, name in names.items()],
)
def test_every_package_is_named_with_its_extra(
    extra: str, module: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError) as caught:
        needed(module, "mesh='a.ply'")
    told = f"mesh='a.ply': {package} is not installed; pip install 'torchtex[{extra}]'"
    assert str(caught.value) == told
    with pytest.raises(ImportError, match=r"'torchtex.*', or name a folder$"):
        needed(module, "output", otherwise="name a folder")


def test_a_part_of_a_package_is_named_with_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.cluster", None)
    with pytest.raises(ImportError, match=r"scikit-learn is not installed.*\[design\]"):
        needed("sklearn.cluster", "layers")


def test_an_extra_is_installed_when_all_of_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXTRAS, "plot", {"json": "json"})
    assert installed("plot")
    monkeypatch.setitem(EXTRAS, "plot", {"json": "json", "no_such_package": "none"})
    assert not installed("plot")
