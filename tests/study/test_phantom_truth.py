"""A truth that a case states for its phantom is the phantom's truth; what would not be used is refused."""

from __future__ import annotations

import importlib
import inspect

import pytest

from case_texts import case_text
from palpate.body import read
from palpate.case.file import read_case
from palpate.errors import ConfigurationError
from palpate.mechanics.laws.mooney_rivlin import MooneyRivlin
from palpate.phantoms.scene import make_scene

PELVIS, SPHERES = (importlib.import_module(f"palpate.phantoms.{name}") for name in ("pelvis", "spheres"))
TISSUES = {
    "spheres": {
        "core": ("estimate", 70.0, 0.49),
        "surroundings": ("known", 12.0, 0.3),
        "frame": ("driver",),
    },
    "pelvis": {"prostate": ("estimate", 80.0, 0.49), "surroundings": ("known", 9.0, 0.3)},
}


@pytest.fixture
def asked(monkeypatch):
    """What a phantom is asked for, in place of its scene."""
    found = {}

    def scene(anatomy, motions, _, **options):
        assert set(options) <= set(inspect.signature(make_scene).parameters)
        found.update(options, anatomy=anatomy, motions=motions)

    monkeypatch.setattr(SPHERES, "make_scene", scene)
    monkeypatch.setattr(PELVIS, "make_scene", scene)
    return found


def case_of(tmp_path, kind: str, *overrides: str):
    keys = ("role", "youngs_modulus_kpa", "poisson_ratio")
    tissues = {name: dict(zip(keys, stated, strict=False)) for name, stated in TISSUES[kind].items()}
    path = tmp_path / "case.toml"
    path.write_text(
        case_text(
            tissues,
            before=None,
            after=None,
            phantom={"kind": kind},
            mechanics={"law": "mooney-rivlin", "c01_over_c10": 1.5},
            motion={"filling_mm": 2.5},
        )
    )
    return read_case(path, overrides)


@pytest.mark.parametrize("kind", TISSUES)
def test_moduli_poisson_ratios_and_the_laws_parameter_of_a_case_are_the_phantoms(kind, tmp_path, asked):
    read.phantom_scene(case_of(tmp_path, kind))
    truth = {t.name: (t.youngs_modulus_kpa, t.poisson_ratio) for t in asked["anatomy"].tissues}
    for name, (_, *stated) in TISSUES[kind].items():
        assert not stated or truth[name] == tuple(stated)
    assert asked["law"] == MooneyRivlin(c01_over_c10=1.5)


@pytest.mark.parametrize("kind", TISSUES)
def test_what_a_case_does_not_state_is_drawn_as_without_it(kind, tmp_path, asked):
    read.phantom_scene(case_of(tmp_path, kind))
    stated = {t.name: (t.youngs_modulus_kpa, t.poisson_ratio) for t in asked["anatomy"].tissues}
    (tmp_path / "plain.toml").write_text(f'phantom = {{ kind = "{kind}" }}')
    read.phantom_scene(read_case(tmp_path / "plain.toml"))
    drawn = {t.name: (t.youngs_modulus_kpa, t.poisson_ratio) for t in asked["anatomy"].tissues}
    others = set(drawn) - set(TISSUES[kind])
    assert others
    assert {name: stated[name] for name in others} == {name: drawn[name] for name in others}


def test_the_walls_of_the_balls_move_as_far_as_the_case_says(tmp_path, asked):
    sizes = []
    for filling in ("2.5", "5.0"):
        read.phantom_scene(case_of(tmp_path, "spheres", f"motion.filling_mm={filling}"))
        sizes.append(asked["motions"]["frame"].gradient)
    assert sizes[1] == pytest.approx(2.0 * sizes[0])


@pytest.mark.usefixtures("asked")
@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("tissues.spleen={role='estimate'}", "no tissue 'spleen'.*others: core"),
        ("tissues.surroundings.role=estimate", "'surroundings' has the role known"),
        ("tissues.core.label=5", "cannot give it the role estimate and the label"),
    ],
)
def test_tissues_that_a_phantom_has_not_are_refused(override, words, tmp_path):
    with pytest.raises(ConfigurationError, match=words):
        read.phantom_scene(case_of(tmp_path, "spheres", override))


def test_loads_on_a_phantom_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="remove the loads"):
        case_of(tmp_path, "spheres", "loads=[{kind='gravity', acceleration_m_s2=[0.0, 0.0, 1.0]}]")


def test_a_correlation_length_without_a_deviation_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="without a surface_sd_mm"):
        case_of(tmp_path, "spheres", "noise.correlation_length_mm=5.0")
