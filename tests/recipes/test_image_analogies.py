"""Image Analogies: copies with a source, wavefronts like scan order, coherence, bad options."""

from typing import Any

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex.matching import Exact
from torchtex.recipes import image_analogies as module
from torchtex.recipes.analogy import Analogy
from torchtex.recipes.image_analogies import copies, image_analogies
from torchtex.recipes.montage import Stage


def halves(h: int, w: int) -> Tensor:
    """A map of two regions, left and right."""
    return (torch.arange(w) >= w // 2).double().expand(1, h, w)


def two_textures(h: int = 32, w: int = 40) -> tuple[Tensor, Tensor]:
    """Stripes on the left and noise on the right, and the map of them."""
    maps = halves(h, w)
    return torch.where(maps > 0, noise(3, h, w), stripes(h, w) * 0.5), maps


def problem(h: int = 21, w: int = 30) -> Analogy:
    source, mapped = two_textures()
    return Analogy.of(source, mapped, halves(h, w).flip(2))


@pytest.mark.parametrize("kappa", [0.0, 5.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pixels_are_copies_from_the_region_that_the_constraint_asks_for(
    kappa: float, dtype: torch.dtype
) -> None:
    source, mapped = (x.to(dtype) for x in two_textures())
    constraint = halves(21, 30).flip(2).to(dtype)
    result = image_analogies(Analogy.of(source, mapped, constraint), kappa=kappa)
    assert result.texture.shape == (3, 21, 30)
    assert result.texture.dtype == dtype
    assert torch.equal(result.apply(source), result.texture)
    assert (result.apply(mapped) != constraint).to(dtype).mean() < 0.1


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (40, 2)])
def test_any_size(size: tuple[int, int]) -> None:
    source, mapped = two_textures()
    result = image_analogies(Analogy.of(source, mapped, torch.zeros(1, *size).double()))
    assert result.texture.shape == (3, *size)


def test_wavefronts_give_what_one_pixel_after_another_gives(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def scan_order(h: int, w: int, slope: int) -> list[Tensor]:
        return list(torch.arange(h * w)[:, None])

    whole = problem()
    fast = image_analogies(whole, matcher=Exact(), window=5, kappa=1.0)
    monkeypatch.setattr(module, "_fronts", scan_order)
    slow = image_analogies(whole, matcher=Exact(), window=5, kappa=1.0)
    assert torch.equal(fast.source_map, slow.source_map)


@pytest.mark.parametrize(("h", "w", "slope"), [(1, 5, 3), (4, 1, 2), (6, 7, 3), (5, 9, 4)])
def test_a_front_needs_only_those_before_it(h: int, w: int, slope: int) -> None:
    fronts = module._fronts(h, w, slope)
    assert torch.cat(fronts).sort()[0].tolist() == list(range(h * w))
    when = torch.empty(h * w, dtype=torch.long)
    for number, front in enumerate(fronts):
        when[front] = number
    when = when.view(h, w)
    reach = slope - 1
    for i in range(h):
        for j in range(w):
            above = when[max(i - reach, 0) : i, max(j - reach, 0) : j + reach + 1]
            assert (above < when[i, j]).all()
            assert (when[i, max(j - reach, 0) : j] < when[i, j]).all()


def test_an_analogy_with_itself_is_the_source() -> None:
    source, mapped = noise(3, 24, 24), noise(2, 24, 24, seed=1)
    result = image_analogies(Analogy.of(source, mapped, mapped))
    assert torch.equal(result.texture, source)
    assert int(result.patches.max()) == 0


def test_a_larger_kappa_makes_fewer_copies() -> None:
    count = [len(image_analogies(problem(), kappa=k).patches.unique()) for k in (0.0, 25.0)]
    assert count[1] < count[0] / 2


def test_several_sources_and_constraints_with_weights() -> None:
    source, mapped = two_textures()
    other = noise(3, 20, 26, seed=4)
    maps = noise(2, 20, 26, seed=5)
    whole = Analogy(
        (source, other),
        ((mapped, noise(2, 32, 40, seed=6)), (torch.full((1, 20, 26), 0.5).double(), maps)),
        (halves(20, 26), maps),
        (0.01, 9.0),
    )
    result = image_analogies(whole, kappa=0.0)
    assert torch.equal(result.apply([source, other]), result.texture)
    assert (result.source_map[..., 0] == 1).double().mean() > 0.9


def test_lightness_and_remapping_change_what_is_compared_not_what_is_copied() -> None:
    mapped = torch.linspace(0, 1, 40).double().expand(1, 32, 40)
    source, dark = mapped.expand(3, -1, -1), mapped[:, :20, 8:32] * 0.2
    whole = Analogy.of(source, mapped, dark)
    plain = image_analogies(whole, kappa=0.0)
    remapped = image_analogies(whole, kappa=0.0, remap=True, lightness=True)
    assert torch.equal(remapped.apply(source), remapped.texture)
    assert remapped.apply(mapped).mean() > plain.apply(mapped).mean() + 0.2


def test_the_same_seed_gives_the_same_bits_and_steps_are_told() -> None:
    told: list[Stage] = []
    first = image_analogies(problem(), seed=3, on_step=told.append)
    assert torch.equal(first.texture, image_analogies(problem(), seed=3).texture)
    done = [stage.done for stage in told]
    assert done == sorted(done)
    assert done[-1] == 1
    assert torch.equal(told[-1].texture, first.texture)

    def stop(stage: Stage) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        image_analogies(problem(), on_step=stop)


def test_copies_are_numbered_by_source_and_shift() -> None:
    positions = torch.tensor([[[0, 1, 1], [0, 1, 2], [1, 1, 3]], [[0, 2, 1], [0, 0, 0], [0, 2, 3]]])
    found = copies(positions)
    assert found[0, 0] == found[0, 1] == found[1, 0] == found[1, 2]
    assert len(found.unique()) == 3


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("kappa=-1", {"kappa": -1.0}),
        ("kappa=inf", {"kappa": float("inf")}),
        ("levels=0 must lie in 1..5", {"levels": 0}),
        ("levels=9 must lie in 1..5", {"levels": 9}),
        ("window=4 must be odd", {"window": 4}),
        ("window=1 must be odd, and at least 3", {"window": 1}),
        ("coarse=2", {"coarse": 2}),
        ("axes=0", {"axes": 0}),
        ("seed=-1 must lie in", {"seed": -1}),
    ],
)
def test_options_that_make_no_sense(words: str, options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=words):
        image_analogies(problem(), **options)
