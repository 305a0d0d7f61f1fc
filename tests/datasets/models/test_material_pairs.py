"""Laws of pairs of materials in a model: in its parameters, its rollouts' parameters, its world and its MJCF."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from cgwm.datasets.models.agreement import require_agreement, require_contact
from cgwm.datasets.models.mjcf import write_mjcf
from cgwm.datasets.models.model import Model
from cgwm.datasets.shapes.meshes import Mesh
from cgwm.pipeline.phys_geo.material_pairs import given_numbers, start_laws, touching_bodies
from cgwm.pipeline.physics import world_of_model
from cgwm.pipeline.synthesize.parameters import draw_parameters, settable, with_parameter
from cgwm.schemas import (
    Body,
    CaptureManifest,
    ContactParameters,
    FittedParameter,
    Ground,
    InputDataError,
    Material,
    MaterialPair,
    ModelFile,
    PairContact,
    Surface,
)
from cgwm.schemas import World as Surroundings
from helpers.fixed_surfaces import groove
from helpers.small_model import small_model
from pydantic import ValidationError

PAIR = PairContact(materials=("wood", "steel"), friction=0.2, contact_time_s=0.005, damping_ratio=0.6)
NAME = "friction[steel,wood]"


def model(**more: object) -> Model:
    """Return the small model with a steel cube on wood."""
    plain = small_model()
    ground = (plain.file.ground or Ground()).model_copy(update={"material": "wood"})
    bodies = tuple(body.model_copy(update={"material": "steel"}) for body in plain.file.bodies)
    fitted = FittedParameter(name=NAME, unit="1", estimate=0.2, std_error=0.02, bounds=(0.01, 2.0))
    update = {"ground": ground, "bodies": bodies, "pairs": (PAIR,), "parameters": (fitted,)} | more
    file = ModelFile.model_validate(plain.file.model_copy(update=update).model_dump())
    return Model(**vars(plain) | {"file": file})


def test_the_only_pair_in_use_is_the_contact_of_the_world() -> None:
    world = world_of_model(model())
    assert float(world.contact.friction) == 0.2 and not world.pair_laws
    other = model(pairs=(PAIR.model_copy(update={"materials": ("ice", "wood")}),), parameters=())
    assert float(world_of_model(other).contact.friction) == 0.4


def test_rollouts_draw_the_parameters_of_a_pair() -> None:
    file = model().file
    assert NAME in settable(file) and "damping_ratio[steel,wood]" in settable(file)
    assert with_parameter(file, NAME, 0.3).pairs[0].friction == 0.3
    drawn, entries = draw_parameters(file, 1.0, np.random.default_rng(0))
    assert entries[0].name == NAME and drawn.pairs[0].friction == entries[0].value != 0.2
    assert drawn.contact == file.contact


def test_a_pair_is_a_pair_of_geoms_in_mjcf() -> None:
    found = ET.fromstring(write_mjcf(model()))
    bodies = found.find("worldbody")
    assert bodies is not None
    pairs, geoms = found.findall("contact/pair"), {geom.get("name") for geom in bodies.iter("geom")}
    assert len(pairs) == len(geoms) - 1 > 0  # each sphere with the ground
    assert all(pair.get("geom1") in geoms and pair.get("geom2") == "ground" for pair in pairs)
    assert {pair.get("friction") for pair in pairs} == {"0.2 0.2 0 0 0"}
    common = ET.fromstring(write_mjcf(model(pairs=(), parameters=())))
    assert {len(pair.attrib) for pair in common.findall("contact/pair")} == {2}  # the law of all is the default
    law = model().file.contact
    assert law is not None
    default = common.find("default/pair")
    assert default is not None and default.get("friction") == f"{law.friction:g} {law.friction:g} 0 0 0"
    assert default.get("solreffriction") == f"{law.contact_time_s:g} 1"


def test_pairs_of_bodies_and_surfaces() -> None:
    surfaces = (
        Surface.model_validate({"name": "sheet", "material": "ice", "rectangle": {"half_extents_m": (1, 1)}}),
        Surface.model_validate({"name": "track", "material": "ice", "mesh": {"path": "track.obj", "inside": "none"}}),
        Surface.model_validate({"name": "post", "cylinder": {"radius_m": 0.1, "half_length_m": 1}}),
    )
    law = PAIR.model_copy(update={"materials": ("ice", "steel"), "friction": 0.03})
    both = model(surfaces=surfaces, pairs=(PAIR, law))
    both = replace(both, surface_meshes={"track": Mesh(*groove(0.3, 3))})
    pairs = ET.fromstring(write_mjcf(both)).findall("contact/pair")
    frictions: dict[str, set[str]] = {}
    for pair in pairs:
        frictions.setdefault(str(pair.get("geom2")), set()).add(str(pair.get("friction")))
    ice = {"0.03 0.03 0 0 0"}
    own = {"ground": {"0.2 0.2 0 0 0"}, "sheet": ice, **{f"track_{k}": ice for k in range(8)}}
    assert frictions == {**own, "post": {"None"}}  # a post without a material has the default law
    steel = Body(name="cube", mass_kg=1.0, material="steel")
    materials = (Material(name="steel"), Material(name="ice", friction=0.1))
    manifest = CaptureManifest(
        format="cgwm-capture/1", bodies=(steel,), materials=materials, surfaces=surfaces[:1],
        pairs=(MaterialPair(materials=("steel", "ice"), friction=0.03),),
    )  # fmt: skip
    laws = start_laws(model(pairs=(), contact=None, parameters=()).file, manifest)
    assert laws.contact.friction == 0.03 and laws.medians == {"friction": 0.03}  # the only pair in use
    assert [str(one) for one in touching_bodies(manifest)] == ["'cube' and surface 'sheet'"]
    linked = manifest.model_copy(update={"bodies": (steel.model_copy(update={"motion": "link"}),)})
    assert [str(one) for one in touching_bodies(linked)] == ["'cube' and surface 'sheet'"]


def test_what_contradicts_itself_is_refused() -> None:
    path = Path("M/model.json")
    wrong = FittedParameter(name=NAME, unit="1", estimate=0.3)
    with pytest.raises(InputDataError, match=r"is 0\.3, but friction of the pair wood and steel is 0\.2"):
        require_agreement(model(parameters=(wrong,)).file, small_model().collision, path)
    with pytest.raises(InputDataError, match=r"is of a pair of materials that pairs does not have\."):
        require_contact(model(pairs=()).file, path)
    with pytest.raises(ValidationError, match="two pairs are of 'steel' and 'wood'"):
        model(pairs=(PAIR, PAIR.model_copy(update={"materials": ("steel", "wood")})))


def manifest(*materials: Material, pairs: tuple[MaterialPair, ...] = ()) -> CaptureManifest:
    """Return a capture of two bodies, a and b, on a ground c, each of the material of its name."""
    return CaptureManifest(
        format="cgwm-capture/1",
        world=Surroundings(ground=Ground(material="c")),
        bodies=(Body(name="a", material="a"), Body(name="b", material="b", motion="driven")),
        materials=materials or tuple(Material(name=name) for name in "abc"),
        pairs=pairs,
    )


def test_what_a_capture_gives_are_medians_and_starts() -> None:
    single = manifest(Material(name="a", friction=0.1), Material(name="b", friction=0.4), Material(name="c"))
    assert given_numbers(single)["a", "b"] == {"friction": pytest.approx(0.2)}
    given = manifest(pairs=(MaterialPair(materials=("c", "a"), friction=0.3, damping_ratio=0.7),))
    laws = start_laws(small_model().file.model_copy(update={"contact": None, "parameters": ()}), given)
    assert [entry.materials for entry in laws.pairs] == [("a", "b"), ("a", "c")]
    assert laws.pairs[1].friction == 0.3 and laws.pairs[0].friction == ContactParameters().friction
    assert laws.medians == {"friction[a,c]": 0.3, "damping_ratio[a,c]": 0.7}
