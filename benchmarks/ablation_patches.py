"""How `benchmarks ablation` takes a mechanism of the estimation away: by a patch, not by a switch.

A patch replaces attributes of classes or modules while a study runs. An attribute that no longer exists makes
it fail, so that the study cannot run on without doing anything.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import wraps
from typing import Any, NamedTuple
from unittest.mock import patch

SMALL, WRONG, MOVED = "sigmas too small", "rig or data wrong", "the delay moved"
HARDLY = 1e-4  # of a prior sigma: the state exists and stays where it is
STEPS = ("nothing", "5 ms", "20 ms", "0.5 deg", "2 deg", "10 mm", "2 deg, 10 mm, 5 ms")
DRIFTS = "clock drifts by 100 ppm from then on"
JUNK = ("nothing", "30 % junk corners for 3 s", "all corners junk for 1 s", "2 deg")
KEPT = ("2 deg", "2 deg, 10 mm, 5 ms", "bump in a gap of 5 s")


class Change(NamedTuple):
    """What to replace.

    Attributes:
        owner: A class or module.
        name: Of its attribute.
        new: The new one.
        of_objects: It is an attribute of the objects of the class, not of the class.
    """

    owner: Any
    name: str
    new: Any
    of_objects: bool = False


@dataclass(frozen=True)
class Mechanism:
    """One mechanism.

    Attributes:
        family: Which question it answers.
        purpose: What it is for.
        changes: Makes the patch.
        free: It belongs to calibration without a target.
        faults: Cases of `ablation_data.FAULTS` that it was made for.
        disturbances: Of `ablation_disturbances.DISTURBANCES`, those that concern it.
    """

    family: str
    purpose: str
    changes: Callable[[], Sequence[tuple[Any, ...]]]
    free: bool = False
    faults: tuple[str, ...] = ()
    disturbances: tuple[str, ...] = ()


@contextmanager
def without(mechanism: Mechanism | None) -> Iterator[None]:
    """The estimation without a mechanism; None: as it is."""
    with ExitStack() as stack:
        for change in mechanism.changes() if mechanism is not None else []:
            owner, name, new, of_objects = Change(*change)
            if of_objects and f"self.{name}" not in inspect.getsource(owner):
                raise AttributeError(f"objects of {owner.__name__} have no {name}")
            stack.enter_context(patch.object(owner, name, new, create=of_objects))
        yield


def gives(value: Any) -> Callable[..., Any]:
    return lambda *_args, **_kwargs: value


def held_at(value: Any) -> property:
    """An attribute that keeps its value whatever is written."""
    return property(lambda _self: deepcopy(value), lambda _self, _new: None)


def then(owner: Any, name: str, do: Callable[[Any], None]) -> tuple[Any, str, Any]:
    """The method as it is, and something done to its object afterwards."""
    method = getattr(owner, name)

    @wraps(method)
    def both(self: Any, *args: Any, **kwargs: Any) -> Any:
        result = method(self, *args, **kwargs)
        do(self)
        return result

    return owner, name, both


def first(owner: Any, name: str, do: Callable[[Any], None]) -> tuple[Any, str, Any]:
    """Something done to the object, then the method as it is."""
    method = getattr(owner, name)

    @wraps(method)
    def both(self: Any, *args: Any, **kwargs: Any) -> Any:
        do(self)
        return method(self, *args, **kwargs)

    return owner, name, both


def put(**values: Any) -> Callable[[Any], None]:
    def put(self: Any) -> None:
        for name, value in values.items():
            setattr(self, name, value)

    return put
