"""Marbling: inverses, periods, gradients, and pictures taken back."""

import math
from dataclasses import replace

import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex.layers.marbling import marble, trace
from torchtex.layers.marbling_words import as_json, load_operations, parse_operation, with_channels
from torchtex.layers.resampling import basis, fit
from torchtex.layers.tines import Comb, Operation, Tine, Wave
from torchtex.layers.whirls import Circle, Drop, Vortex

SIZE = (48, 40)
EXACT: list[Operation] = [
    Tine(30.0, shift=0.2, width=0.08),
    Tine(90.0, shift=-0.3, row=0.1, column=0.9),
    Comb(3, 135.0, shift=0.2, width=0.1),
    Wave(0.1, 2, 1, phase=0.2),
    Circle(0.3, 0.6, radius=0.2, shift=0.3, width=0.1),
    Vortex(0.8, 0.1, turn=200.0, radius=0.2),
]
DROP = Drop(0.4, 0.7, radius=0.15)


def places(count: int = 400) -> Tensor:
    return (noise(2, count, seed=3) * 3 - 1) * torch.tensor(SIZE)[:, None]


def smooth(channels: int = 3, size: tuple[int, int] = SIZE) -> Tensor:
    """A tile with a few waves."""
    row = torch.arange(size[0], dtype=torch.float64)[:, None] / size[0]
    col = torch.arange(size[1], dtype=torch.float64)[None] / size[1]
    waves = [torch.sin(2 * math.pi * ((k + 1) * row + 2 * col + 0.1 * k)) for k in range(channels)]
    return 0.5 + 0.3 * torch.stack(waves)


def psnr(a: Tensor, b: Tensor) -> float:
    return -10 * math.log10(float((a - b).square().mean()))


# --------------------------------------------------------------------------------- maps


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("operation", EXACT, ids=lambda o: type(o).__name__)
def test_back_is_the_inverse_of_forward_everywhere(operation: Operation, periodic: bool) -> None:
    at = places()
    moved = operation.forward(at, SIZE, periodic)
    assert float((moved - at).abs().max()) > 0.5
    assert torch.allclose(operation.back(moved, SIZE, periodic), at, atol=1e-9)
    again = operation.forward(operation.back(at, SIZE, periodic), SIZE, periodic)
    assert torch.allclose(again, at, atol=1e-9)


@pytest.mark.parametrize("periodic", [False, True])
def test_a_drop_is_inverted_away_from_its_centre(periodic: bool) -> None:
    at = places()
    moved = DROP.forward(at, SIZE, periodic)
    assert not DROP.covers(moved, SIZE, periodic).any()
    assert torch.allclose(DROP.back(moved, SIZE, periodic), at, atol=1e-6)


def test_a_drop_keeps_areas_outside_of_it() -> None:
    at = places().requires_grad_()
    moved = DROP.back(at, SIZE, False)
    rows = torch.autograd.grad(moved[0].sum(), at, retain_graph=True)[0]
    cols = torch.autograd.grad(moved[1].sum(), at)[0]
    area = rows[0] * cols[1] - rows[1] * cols[0]
    outside = ~DROP.covers(at.detach(), SIZE, False)
    assert torch.allclose(area[outside], torch.ones_like(area[outside]), atol=1e-7)


@pytest.mark.parametrize("operation", [*EXACT, DROP], ids=lambda o: type(o).__name__)
def test_periodic_maps_repeat_with_the_tile(operation: Operation) -> None:
    at = places()
    step = torch.tensor([[2.0 * SIZE[0]], [-1.0 * SIZE[1]]], dtype=torch.float64)
    for move in (operation.forward, operation.back):
        assert torch.allclose(move(at + step, SIZE, True), move(at, SIZE, True) + step, atol=1e-9)


@pytest.mark.parametrize("operation", [*EXACT[:1], *EXACT[2:], DROP])
def test_periodic_maps_have_no_jump(operation: Operation) -> None:
    line = torch.linspace(-40, 90, 40001, dtype=torch.float64)
    for at in (
        torch.stack([line, torch.full_like(line, 7.3)]),
        torch.stack([torch.full_like(line, 9.1), line]),
    ):
        steps = operation.forward(at, SIZE, True).diff(dim=1).norm(dim=0)
        assert float(steps.max()) < 0.1


def test_paint_on_a_line_moves_by_the_shift_and_half_as_far_at_the_width() -> None:
    tine = Tine(0.0, shift=0.5, width=0.25)
    at = torch.tensor([[19.5, 29.5], [3.0, 3.0]], dtype=torch.float64)
    moved = tine.forward(at, (40, 40), False) - at
    assert torch.allclose(moved[1], torch.tensor([20.0, 10.0], dtype=torch.float64))
    assert torch.allclose(moved[0], torch.zeros(2, dtype=torch.float64))


def test_ink_moves_with_later_operations_and_covers_earlier_drops() -> None:
    small, large = Drop(0.5, 0.5, 0.1, color=(1.0,)), Drop(0.5, 0.5, 0.2, color=(0.0,))
    shift = Tine(0.0, shift=0.25, width=1e6)  # all of it
    at = torch.tensor([[19.5, 19.5, 1.0], [19.5, 29.5, 1.0]], dtype=torch.float64)
    _, ink = trace([small, large, shift], at, (40, 40))
    assert ink.tolist() == [-1, 1, -1]
    _, ink = trace([large, small], at[:, :1], (40, 40))
    assert ink.tolist() == [1]
    _, ink = trace([small, large], at[:, :1] + torch.tensor([[0.0], [8.2]]), (40, 40))
    assert ink.tolist() == [0]  # pushed out of the middle, a ring


def test_numbers_may_be_tensors_with_gradients() -> None:
    at = places(20)
    value = torch.tensor([0.2, 40.0, 0.3], dtype=torch.float64, requires_grad=True)

    def moved(v: Tensor) -> Tensor:
        design: list[Operation] = [
            Tine(v[1], shift=v[0], width=v[2]),
            Circle(v[0], 0.5, radius=v[2]),
            Vortex(v[0], v[2], turn=v[1]),
            Wave(v[0], 1.0, 2.0),
            Drop(0.5, 0.5, radius=v[2]),
        ]
        return trace(design, at, SIZE)[0]

    assert torch.autograd.gradcheck(moved, (value,))


# --------------------------------------------------------------------------------- pictures


@pytest.mark.parametrize("operation", EXACT, ids=lambda o: type(o).__name__)
def test_a_marbled_picture_can_be_taken_back(operation: Operation) -> None:
    image = smooth(size=(96, 80))
    there = marble(image, [operation], periodic=True)
    assert psnr(there, image) < 25
    assert psnr(marble(there, [operation], periodic=True, undo=True), image) > 35


def test_a_whole_design_is_taken_back_in_one_reading_away_from_drops() -> None:
    image = smooth(size=(96, 80))
    design = [Vortex(turn=90.0, radius=0.2), Drop(0.5, 0.5, 0.1, (1.0, 0.0, 0.0)), Tine(90.0)]
    there = marble(image, design, periodic=True, size=(192, 160))
    back = marble(there, design, periodic=True, undo=True, size=(96, 80))
    row = torch.arange(96)[:, None] - 47.5
    col = torch.arange(80)[None] - 39.5
    away = (row**2 + col**2).sqrt() > 16
    assert psnr(back[:, away], image[:, away]) > 35


@pytest.mark.parametrize("operation", [*EXACT, DROP], ids=lambda o: type(o).__name__)
def test_the_border_of_a_tile_is_a_place_like_any_other(operation: Operation) -> None:
    image = noise(2, *SIZE)
    if isinstance(operation, Wave):
        moved: Operation = replace(operation, phase=operation.phase - 1.5)
    else:
        there = {"row": operation.row + 0.5, "column": operation.column + 0.5}
        moved = replace(operation, **there)
    half = (SIZE[0] // 2, SIZE[1] // 2)
    drawn = marble(image, [operation, Vortex(0.6, 0.7)], periodic=True)
    other = marble(image.roll(half, (1, 2)), [moved, Vortex(1.1, 1.2)], periodic=True)
    assert torch.allclose(drawn.roll(half, (1, 2)), other, atol=1e-8)


def test_a_texture_that_is_no_tile_is_mirrored_beyond_its_border() -> None:
    image = noise(1, 12, 10)
    drawn = marble(image, [Tine(0.0, shift=0.5, width=1e9)], samples=1)
    assert torch.allclose(drawn[:, :, 5:], image[:, :, :5], atol=1e-6)
    assert torch.allclose(drawn[:, :, :5], image[:, :, :5].flip(2), atol=1e-6)


def test_nothing_done_is_nothing_changed_in_any_degree_and_dtype() -> None:
    image = noise(2, 9, 14)
    for degree in (1, 3, 5, 7):
        for periodic in (False, True):
            same = marble(image, [], periodic=periodic, degree=degree)
            assert torch.allclose(same, image, atol=1e-10)
    assert marble(image.float(), [Tine()]).dtype == torch.float32


def test_gradients_flow_to_the_image_and_to_the_design() -> None:
    image = (0.3 + 0.4 * noise(1, 6, 7)).requires_grad_()
    shift = torch.tensor(0.11, dtype=torch.float64, requires_grad=True)

    def drawn(z: Tensor, s: Tensor) -> Tensor:
        return marble(z, [Tine(20.0, shift=s, width=0.5), Wave(0.02, 1, 0)], periodic=True)

    out = drawn(image, shift)
    assert bool(((out > 0.01) & (out < 0.99)).all())
    assert torch.autograd.gradcheck(lambda z, s: drawn(z, s).sum(), (image, shift), atol=1e-3)


def test_squeezed_stripes_turn_grey_and_not_into_false_patterns() -> None:
    stripes = (torch.arange(64) % 2).double().expand(1, 64, 64)
    drawn = marble(stripes, [], size=(16, 16), samples=8, degree=1)
    assert float(drawn.std()) < 0.1
    assert float(marble(stripes, [], size=(16, 16), samples=1, degree=1).std()) < 1e-9


def test_drops_have_smooth_rims() -> None:
    drawn = marble(torch.zeros(1, 32, 32), [Drop(0.5, 0.5, 0.25, (1.0,))])
    assert len(drawn.unique()) > 4
    assert abs(float(drawn.sum()) - math.pi * 64) < 2


def test_same_bits_for_any_number_of_threads() -> None:
    image = noise(3, 40, 50, dtype=torch.float32)
    design = [*EXACT, DROP]
    one = marble(image, design, periodic=True)
    torch.set_num_threads(2)
    assert torch.equal(marble(image, design, periodic=True), one)


# --------------------------------------------------------------------------------- splines


@pytest.mark.parametrize("degree", [1, 3, 5, 7])
def test_splines_reproduce_polynomials_and_pass_through_the_pixels(degree: int) -> None:
    t = noise(50)
    weights = torch.stack(basis(t, degree))
    assert torch.allclose(weights.sum(0), torch.ones(50, dtype=torch.float64))
    steps = torch.arange(degree + 1)[:, None] - (degree - 1) // 2
    assert torch.allclose((weights * steps).sum(0), t)
    image = noise(2, 7, 6)
    at = torch.stack(torch.meshgrid(torch.arange(7.0), torch.arange(6.0), indexing="ij"))
    for periodic in (False, True):
        read = fit(image, periodic=periodic, degree=degree)(at.flatten(1).double())
        assert torch.allclose(read.view(2, 7, 6), image, atol=1e-10)


# --------------------------------------------------------------------------------- words


def test_words_and_files_name_the_same_operations(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("words")
    (folder / "a.json").write_text(
        '[{"operation": "comb", "tines": 4, "angle": 10}, '
        '{"operation": "drop", "radius": 0.2, "color": [0.0, 1.0, 0.0]}]'
    )
    found = load_operations(folder / "a.json")
    words = [parse_operation("comb:4,10"), parse_operation("drop:radius=.2,color=#00ff00")]
    assert found == words == [Comb(4, 10.0), Drop(radius=0.2, color=(0.0, 1.0, 0.0))]
    assert as_json(found[0])["tines"] == 4
    assert with_channels(found[1], 1).color == (0.587,)
    assert with_channels(found[1], 3) is found[1]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("tyne", "did you mean tine"),
        ("xyz", "known are tine"),
        ("tine:abc", "angle=abc must be a number"),
        ("tine:angle=nan", "angle=nan must be a number"),
        ("tine:angel=3", "no 'angel'"),
        ("tine:1,2,3,4,5,6", "no place for '6'"),
        ("tine:angle=1,2", "no place for '2'"),
        ("tine:angle=1,angle=2", "gives angle twice"),
        ("tine:width=0", "width=0.0 must be above 0"),
        ("comb:tines=2.5", "tines=2.5 must be whole"),
        ("comb:tines=0", "tines=0 must be at least 1"),
        ("wave:rows=0,columns=0", "no wave"),
        ("drop:color=red", "must be #rrggbb"),
    ],
)
def test_bad_words_get_one_sentence(text: str, words: str) -> None:
    with pytest.raises(ValueError, match="op=") as caught:
        parse_operation(text)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[", "is not JSON"),
        ("{}", "no list of operations"),
        ("[]", "holds no operations"),
        ('[{"angle": 3}]', "operation 1 has no name"),
        ('[{"operation": "tine", "angle": "3"}]', "angle has '3'"),
        ('[{"operation": "tine"}, {"operation": "drop", "color": 3}]', "operation 2: color=3"),
    ],
)
def test_bad_files_get_one_sentence(
    tmp_path_factory: pytest.TempPathFactory, content: str, words: str
) -> None:
    path = tmp_path_factory.mktemp("bad") / "a.json"
    path.write_text(content)
    with pytest.raises(ValueError, match="operations=") as caught:
        load_operations(path)
    assert words in str(caught.value)


def test_bad_arguments_get_one_sentence() -> None:
    image = noise(3, 8, 8)
    with pytest.raises(ValueError, match=r"color=.*2 values and the image 3 channels"):
        marble(image, [Drop(color=(0.1, 0.2))])
    with pytest.raises(ValueError, match="samples=0"):
        marble(image, [], samples=0)
    with pytest.raises(ValueError, match="size="):
        marble(image, [], size=(0, 4))
    with pytest.raises(ValueError, match="degree=2"):
        marble(image, [], degree=2)
    with pytest.raises(ValueError, match=r"rows=1\.5 must be whole"):
        marble(image, [Wave(0.1, 1.5, 0.0)], periodic=True)
    with pytest.raises(ValueError, match=r"radius=0\.5 must be below 0\.45"):
        marble(image, [Drop(radius=0.5)], periodic=True)
    with pytest.raises(ValueError, match=r"radius=0\.5 must be below 0\.45"):
        marble(image, [Circle(radius=0.5)], periodic=True)
    with pytest.raises(ValueError, match=r"color=.*must lie"):
        Drop(color=(2.0,))
