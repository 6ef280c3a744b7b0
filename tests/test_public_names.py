"""What a module offers is named, importable and documented, with the shape of every array."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from types import ModuleType

import pytest

import palpate
import palpate_validation

PACKAGES = {"palpate.": palpate.__path__, "palpate_validation.": palpate_validation.__path__}
MODULES = sorted(m.name for name, path in PACKAGES.items() for m in pkgutil.walk_packages(path, name))
COUNT = r"(?:\d+ )?(?:\d+|n\w*|[km]|draws)(?: [+/] (?:\d+|n_\w+))?(?: corners| axes)?"
SHAPE = re.compile(rf"\({COUNT}(?:,|(?:, {COUNT})+)\)")  # (n, 3), (n_nodes,), (3 n_points, n_modes + 1)


def public(module: ModuleType):
    """Name and object of each public function and method that the module itself defines."""
    for name, thing in vars(module).items():
        if name.startswith("_") or getattr(thing, "__module__", None) != module.__name__:
            continue
        if inspect.isfunction(thing):
            yield name, thing, ""
        elif inspect.isclass(thing):
            for key, member in vars(thing).items():
                function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
                if not key.startswith("_") and inspect.isfunction(function):
                    yield f"{name}.{key}", function, thing.__doc__ or ""


def test_shapes_are_told_from_other_parentheses():
    assert all(map(SHAPE.search, ("(n,)", "(n, 3)", "(n_free, k)", "(n_regions + n_modes,)", "(3 n_points, n_modes)")))
    assert not any(map(SHAPE.search, ("(mm)", "(n)", "(see elsewhere, mm)", "(Nocedal, 2006)")))


def test_the_package_offers_what_it_names():
    assert palpate.__all__ == sorted(palpate.__all__)
    for name in palpate.__all__:
        thing = getattr(palpate, name)
        assert callable(thing)
        assert thing.__name__.removeprefix("palpate.") == name  # a package that can be called, or the function itself
    with pytest.raises(AttributeError, match="no attribute 'estimat'"):
        palpate.estimat  # noqa: B018


@pytest.mark.parametrize("name", MODULES)
def test_a_module_sorts_its_names_and_keeps_them(name):
    module = importlib.import_module(name)
    names = vars(module).get("__all__", [])
    assert module.__doc__, f"{name} has no docstring"
    assert names == sorted(names, key=lambda word: (not word.isupper(), not word[0].isupper(), word))
    assert len(names) == len(set(names))
    for public_name in [*names, *dir(module)]:
        assert hasattr(module, public_name), f"{name} names {public_name}, which is not there"


@pytest.mark.parametrize("name", MODULES)
def test_every_public_class_and_function_says_what_it_is(name):
    module = importlib.import_module(name)
    own = {key: thing for key, thing in vars(module).items() if getattr(thing, "__module__", None) == name}
    silent = [key for key, thing in own.items() if inspect.isclass(thing) and key[0] != "_" and not thing.__doc__]
    silent += [label for label, function, _ in public(module) if not inspect.getdoc(function)]
    assert not silent


@pytest.mark.parametrize("name", MODULES)
def test_every_function_with_arrays_gives_a_shape(name):
    """An array among arguments or results needs a shape such as (n, 3), or (n_nodes,), in the docstring."""
    shapeless = []
    for label, function, around in public(importlib.import_module(name)):
        annotations = " ".join(str(annotation) for annotation in inspect.get_annotations(function).values())
        if "NDArray" in annotations and not SHAPE.search(f"{inspect.getdoc(function) or ''} {around}"):
            shapeless.append(label)
    assert not shapeless
