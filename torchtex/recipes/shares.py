"""Progress of a part of a recipe, told as progress of all of it."""

from collections.abc import Callable

from torchtex.recipes.montage import Stage

Tell = Callable[[Stage], None]


def share(tell: Tell | None, start: float, part: float, note: str | None = None) -> Tell:
    """Steps of a part that begins when `start` of the whole is done and is `part` of it.

    Args:
        tell: is given the steps; None for nobody.
        note: instead of what the part says it does.

    Example:
        >>> import torch
        >>> told: list[float] = []
        >>> second = share(lambda stage: told.append(stage.done), 0.5, 0.25)
        >>> second(Stage(1.0, "filling", torch.zeros(1, 2, 2)))
        >>> told
        [0.75]
    """

    def told(stage: Stage) -> None:
        if tell is not None:
            done = min(1.0, start + part * stage.done)
            tell(Stage(done, note or stage.note, stage.texture, stage.detail))

    return told
