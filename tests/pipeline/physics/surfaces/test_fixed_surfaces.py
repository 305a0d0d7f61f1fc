"""Fixed surfaces: exact distances, contacts with meshes, and rolling without falling through."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.pipeline.physics import engine, simulate
from cgwm.pipeline.physics.contact_detection import Placed
from cgwm.pipeline.physics.surfaces.detection import MOST_GAP_M, all_surface_points, near_surface, surface_gap
from cgwm.pipeline.physics.surfaces.fixed_surface import FixedSurface
from cgwm.pipeline.physics.surfaces.mesh_neighbourhood import Neighbourhood
from cgwm.pipeline.physics.surfaces.mesh_topology import Topology
from cgwm.pipeline.physics.surfaces.surface_mesh import FEATURES, SurfaceMesh, _closest
from cgwm.schemas import InputDataError
from helpers import fixed_surfaces as fixed
from helpers.worlds import F64, ball_body, box_body, law, state_of, times, world_of

LEVEL = ((1, 0, 0, 0), (0, 0, 0), (0, 0, 0))


def contacts(surface: FixedSurface, centers: list, radius: float = 0.02) -> list[list[tuple[float, list[float]]]]:
    """Return gaps and normals of the contacts of balls."""
    place = torch.tensor(centers, dtype=F64)
    zero = torch.zeros_like(place)
    placed = Placed(ball_body(radius), place, torch.eye(3, dtype=F64).expand(len(place), 3, 3), zero, zero)
    points = all_surface_points(placed, surface)
    return [
        [(float(g), n.tolist()) for g, n in zip(gaps, normals, strict=True) if g < 1]
        for gaps, normals in zip(points.gap, points.normal, strict=True)
    ]


BOX = fixed.box((0.1, 0.2, 0.3))


@pytest.mark.parametrize(
    ("surface", "at", "distance", "normal"),
    [
        (fixed.half_space(position=(0, 0, 0.1)), (5, 3, 0.4), 0.3, (0, 0, 1)),
        (BOX, (0.25, 0, 0), 0.15, (1, 0, 0)),
        (BOX, (0.13, -0.24, 0), 0.05, (0.6, -0.8, 0)),  # an edge
        (BOX, (0.12, 0.22, 0.31), 0.03, (2 / 3, 2 / 3, 1 / 3)),  # a corner
        (BOX, (-0.09, 0.01, 0), -0.01, (-1, 0, 0)),  # the shortest way out
        (fixed.box((0.1, 0.2, 0)), (0.05, 0.1, -0.04), 0.04, (0, 0, -1)),  # a sheet, from below
        (fixed.box((0.1, 0.2, 0)), (0.13, 0, 0.04), 0.05, (0.6, 0, 0.8)),
        (fixed.cylinder(0.1, 0.3), (0.09, 0.12, 0.1), 0.05, (0.6, 0.8, 0)),
        (fixed.cylinder(0.1, 0.3), (0.0, 0.05, 0.35), 0.05, (0, 0, 1)),
        (fixed.cylinder(0.1, 0.3), (0.0, 0.13, -0.34), 0.05, (0, 0.6, -0.8)),  # the rim
        (fixed.cylinder(0.1, 0.3), (-0.08, 0, 0), -0.02, (-1, 0, 0)),
        (fixed.cylinder(0.1, 0.3), (0, 0, 0.28), -0.02, (0, 0, 1)),
        (fixed.box((0.1, 0.2, 0.3), quat=fixed.turn((0, 0, 1), 90)), (0.0, 0.15, 0), 0.05, (0, 1, 0)),
    ],
)
def test_distances_to_shapes_are_exact(surface: FixedSurface, at: tuple, distance: float, normal: tuple) -> None:
    ((gap, found),) = contacts(surface, [at])[0]
    assert gap == pytest.approx(distance - 0.02, abs=1e-14)
    assert found == pytest.approx(normal, abs=1e-12)


def test_a_closed_mesh_of_a_box_is_that_box() -> None:
    half = (0.1, 0.2, 0.3)
    vertices, faces = fixed.box_mesh(half)
    mesh, exact = fixed.mesh_surface(vertices, faces, solid=True), fixed.box(half)
    places = (np.random.default_rng(2).uniform(-1.2, 1.2, (400, 3)) * half).tolist()
    near = 0
    for at, of_mesh, of_box in zip(places, contacts(mesh, places), contacts(exact, places), strict=True):
        ((gap, normal),) = of_box
        if -0.08 < gap + 0.02 < 0.06:  # within the cells about the surface
            near += 1
            ((found, direction),) = of_mesh
            assert found == pytest.approx(gap, abs=1e-12), at
            assert direction == pytest.approx(normal, abs=1e-9), at
    assert near > 150


def test_contacts_of_a_mesh_are_the_minima_of_the_distance() -> None:
    groove = fixed.mesh_surface(*fixed.groove())
    s = math.sqrt(0.5)
    grid = np.linspace(-0.04, 1.0, 40)  # over inner edges, corners and triangles
    for found in contacts(groove, [(x, 0.003, 0.02) for x in grid]):
        assert sorted(normal[1] for _, normal in found) == pytest.approx([-s, s])
        assert sorted(gap for gap, _ in found) == pytest.approx([s * (0.02 - 0.003) - 0.02, s * 0.023 - 0.02])
    below = contacts(groove, [(x, 0.0, -0.01) for x in grid])  # from the other side, its keel is one convex edge
    assert all(len(found) == 1 and found[0] == (pytest.approx(-0.01), pytest.approx([0, 0, -1])) for found in below)


def test_a_corner_of_three_walls_has_three_contacts_and_the_tip_one() -> None:
    vertices = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    corner = fixed.mesh_surface(vertices, [(0, 1, 2), (0, 2, 3), (0, 3, 1)])
    inner, outer = contacts(corner, [(0.015, 0.016, 0.017), (-0.01, -0.01, -0.005)])
    assert sorted(gap for gap, _ in inner) == pytest.approx([-0.005, -0.004, -0.003])
    assert [(gap, normal) for gap, normal in outer] == [
        (pytest.approx(-0.005), pytest.approx([-2 / 3, -2 / 3, -1 / 3]))
    ]


def test_a_height_field_is_solid_below() -> None:
    vertices = [(x, y, 0.0) for x in (0, 1) for y in (0, 1)]
    sheet = fixed.mesh_surface(vertices, [(0, 2, 3), (0, 3, 1)], solid=True)
    found = contacts(sheet, [(0.4, 0.5, 0.01), (0.4, 0.5, -0.3)])
    assert [[gap for gap, _ in one] for one in found] == [[pytest.approx(-0.01)], [pytest.approx(-0.32)]]
    assert all(one[0][1] == [0, 0, 1] for one in found)


def test_degenerate_triangles_are_refused() -> None:
    with pytest.raises(InputDataError, match="mesh: 1 of 1 triangles are degenerate, the first at"):
        fixed.mesh_surface([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)])


@pytest.mark.parametrize("kind", [pytest.param("planes", marks=pytest.mark.evidence), "mesh"])
def test_a_ball_rolls_down_a_groove_at_the_analytic_acceleration(kind: str) -> None:
    """Rolling about the line between two contacts at r / sqrt(2): a = g sin / (1 + 2/5 r^2 / (r^2 / 2))."""
    slope, radius = 10.0, 0.02
    tilt = fixed.turn((0, 1, 0), slope)
    if kind == "mesh":
        surfaces = (fixed.mesh_surface(*fixed.groove(), quat=tilt),)
    else:
        turns = [fixed.times_turn(tilt, fixed.turn((1, 0, 0), degrees)) for degrees in (-45, 45)]
        surfaces = tuple(fixed.half_space(f"side{k}", quat=quat) for k, quat in enumerate(turns))
    world = replace(world_of(ball_body(radius), contact=law(0.5), ground=False), surfaces=surfaces)
    sine, cosine = math.sin(math.radians(slope)), math.cos(math.radians(slope))
    height = radius * math.sqrt(2)
    state = state_of(((height * sine, 0, height * cosine), *LEVEL))
    time = times(1.4, 10)
    with torch.no_grad():
        found = engine.rollout(world, state, time)
    down = torch.tensor([cosine, 0, -sine], dtype=F64)
    speed = found.velocity_m_s[0, :, 0] @ down
    assert float(speed[-1] - speed[4]) == pytest.approx(9.81 * sine / 1.8 * float(time[-1] - time[4]), rel=1e-6)
    up = found.position_m[0, :, 0] @ torch.tensor([sine, 0, cosine], dtype=F64)
    assert float((up - height).abs().max()) < 5e-4
    assert float(found.position_m[0, -1, 0] @ down) > 0.9


def test_momentum_labels_hold_in_a_box_of_walls() -> None:
    """The impulses of the contacts, with that of gravity, are the change of momentum."""
    vertices, faces = fixed.groove(0.2, 4)
    surfaces = (fixed.mesh_surface(vertices, faces), fixed.box((0.01, 0.2, 0.2), position=(0.06, 0, 0)))
    world = replace(world_of(ball_body(0.02), contact=law(0.3), ground=False), surfaces=surfaces)
    state = state_of(((0, 0.01, 0.06), (1, 0, 0, 0), (0.4, 0.1, 0), (0, 1, 0)))
    with torch.no_grad():
        found = simulate(world, state, times(0.25, 20), record_contacts=True)
    assert found.contacts is not None
    change = 0.2 * found.velocity_m_s[0, :, 0].diff(dim=0) - 0.05 * 0.2 * world.gravity
    impulse = found.contacts.impulse_n_s[0, 1:].sum(1)
    torch.testing.assert_close(impulse, change, rtol=0, atol=1e-12)
    acted = found.contacts.impulse_n_s[0].norm(dim=-1) > 0
    assert {int(b) for b, yes in zip(found.contacts.body_b, acted.any(0), strict=True) if yes} == {-2, -3}
    along = (found.contacts.impulse_n_s * found.contacts.normal).sum(-1)[0][acted]
    assert float((along / found.contacts.impulse_n_s[0].norm(dim=-1)[acted]).min()) > 0.9 / math.sqrt(1.09)


def test_a_ball_far_from_all_surfaces_flies() -> None:
    surfaces = (fixed.mesh_surface(*fixed.groove()), fixed.box((0.1, 0.1, 0.1)), fixed.cylinder(0.1, 0.1))
    world = replace(world_of(ball_body(), ground=False), surfaces=surfaces)
    state = state_of(((0, 0, 5.0), *LEVEL))
    free = replace(world, surfaces=())
    with torch.no_grad():
        found, expected = (simulate(one, state, times(0.1, 20)) for one in (world, free))
    assert torch.equal(found.position_m, expected.position_m)


def test_the_nearest_place_of_a_triangle_is_on_it_and_nothing_of_it_is_nearer() -> None:
    generator = torch.Generator().manual_seed(0)
    corners = torch.randn(4, 3, 3, generator=generator, dtype=F64)
    points = 2 * torch.randn(60, 3, generator=generator, dtype=F64)
    offset, region = _closest(points.repeat_interleave(4, 0), corners.repeat(60, 1, 1))
    offset, region = offset.view(60, 4, 3), region.view(60, 4)
    assert set(region.flatten().tolist()) == set(range(7))
    foot = points[:, None] - offset
    weights = torch.linalg.solve(corners.mT, foot[..., None])[..., 0]  # of the corners
    assert float(weights.min()) > -1e-9
    torch.testing.assert_close(weights.sum(-1), torch.ones(60, 4, dtype=F64))
    first, second = torch.rand(2, 400, generator=generator, dtype=F64)
    shares = torch.stack((1 - first.sqrt(), first.sqrt() * (1 - second), first.sqrt() * second), -1)
    others = (points[:, None, None] - shares @ corners).norm(dim=-1).amin(-1)
    assert bool((offset.norm(dim=-1) <= others + 1e-12).all())


def test_pseudonormals_of_a_closed_mesh_point_outwards_and_borders_have_none() -> None:
    vertices, faces = (np.asarray(part) for part in fixed.box_mesh((0.1, 0.2, 0.3)))
    closed = Topology.of(vertices, faces, solid=True, name="box")
    middle = closed.corners.mean((0, 1))
    corners = closed.corners - middle
    places = np.concatenate((corners.mean(1)[:, None], 0.5 * (corners + np.roll(corners, -1, 1)), corners), 1)
    assert ((places * closed.pseudonormals).sum(-1) > 0.05).all()
    # the angles of a side about a vertex: all around within it, half of that at an edge, a quarter at a corner
    sides = (np.abs(places[:, 4:]) > np.array([0.1, 0.2, 0.3]) - 1e-9).astype(float)
    angles = 4 * np.pi / 2 ** sides.sum(-1, keepdims=True)
    np.testing.assert_allclose(closed.pseudonormals[:, 4:], angles * sides * np.sign(places[:, 4:]), atol=1e-9)
    open_ = Topology.of(vertices, faces[2:], solid=False, name="open")  # two neighbouring triangles are missing
    gone = {tuple(vertices[k]) for k in faces[:2].reshape(-1)}
    border = np.array([[tuple(corner) in gone for corner in corners] for corners in open_.corners])
    assert border.any() and not border.all()
    np.testing.assert_array_equal((open_.pseudonormals[:, 4:] == 0).all(-1), border)


def test_a_body_nears_a_surface_by_its_speed_and_by_its_spin() -> None:
    plane, body, step = fixed.half_space(), box_body(), torch.tensor([0.01], dtype=F64)
    reach = float((body.centers[0].norm(dim=-1) + body.radii[0]).max())
    turn, still = torch.eye(3, dtype=F64)[None], torch.zeros(1, 3, dtype=F64)

    def near(above_m: float, speed_m_s: float, spin_rad_s: float) -> bool:
        place = torch.tensor([[0.0, 0.0, reach + above_m]], dtype=F64)
        moving = (torch.tensor([[v, 0.0, 0.0]], dtype=F64) for v in (speed_m_s, spin_rad_s))
        return near_surface(Placed(body, place, turn, *moving), plane, step) is not None

    assert near(0.015, 2.0, 0.0) and not near(0.025, 2.0, 0.0)
    assert near(0.015 + 0.01 * 10 * reach, 2.0, 10.0) and not near(0.025 + 0.01 * 10 * reach, 2.0, 10.0)
    far = Placed(body, torch.tensor([[0.0, 0.0, 2 * MOST_GAP_M + 1]], dtype=F64), turn, still, still)
    assert surface_gap(far, plane).tolist() == [math.inf]


def _rough(rough_m: float) -> SurfaceMesh:
    """Return a sheet of 128 triangles, whose corners are as much too high or too low."""
    generator = np.random.default_rng(3)
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(-0.1, 0.1, 9), np.linspace(-0.1, 0.1, 9)))
    vertices = np.stack((x, y, rough_m * generator.standard_normal(81)), 1)
    first = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate((first[:, None] + [0, 1, 10], first[:, None] + [0, 10, 9]))
    return SurfaceMesh(Topology.of(vertices, faces, solid=False, name="rough"))


@pytest.mark.parametrize(("mesh", "share"), [(_rough(0.0), 0.8), (_rough(1e-4), 0.8), (_rough(0.02), 0.1)])
def test_no_contact_is_on_a_triangle_that_counts_as_beside(mesh: SurfaceMesh, share: float) -> None:
    generator = np.random.default_rng(0)
    places, reach = generator.uniform((-0.1, -0.1, -0.05), (0.1, 0.1, 0.05), (2000, 3)), 0.04
    # half of them straight above and below edges and corners
    feature = generator.integers(1, 7, 1000)
    triangle = generator.integers(0, len(mesh.topology.corners), 1000)
    corners, normals = mesh.topology.corners[triangle], mesh.topology.pseudonormals[triangle, 0]
    ends = np.arange(1000), feature % 3
    middle = np.where(feature[:, None] > 3, corners[ends], 0.5 * (corners + np.roll(corners, -1, 1))[ends])
    places[:1000] = middle + normals * generator.uniform(-0.04, 0.04, (1000, 1))
    centers = torch.from_numpy(places)
    radii = torch.full((2000,), reach, dtype=F64)
    distance, found = mesh.features(centers, radii, 0 * radii)
    sphere, slot = torch.isfinite(distance).nonzero(as_tuple=True)
    assert len(sphere) > 1000 and int((found[sphere, slot] % FEATURES > 0).sum()) > 100
    assert not _beside(mesh, (found[sphere, slot] // FEATURES).numpy(), places[sphere], reach).any()
    sphere, triangle = (part.numpy() for part in mesh._pairs(centers, radii))
    assert _beside(mesh, triangle, places[sphere], reach).mean() > share
    # what is looked up by cells of centres is what is not beside, and little more
    near = Neighbourhood.of(mesh.topology, reach)
    cell = np.floor((places - near.low) / near.cell_m).astype(int)
    within = ((cell >= 0) & (cell < near.cells)).all(1)
    flat = (cell[:, 0] * near.cells[1] + cell[:, 1]) * near.cells[2] + cell[:, 2]
    looked = {
        (one, int(other))
        for one in np.flatnonzero(within)
        for other in near.triangles[near.starts[flat[one]] : near.starts[flat[one] + 1]]
    }
    kept = ~_beside(mesh, triangle, places[sphere], reach)
    wanted = {(int(a), int(b)) for a, b in zip(*found_pairs(mesh, distance, found), strict=True)}
    assert wanted <= looked and (len(looked) < 4 * kept.sum() or share < 0.5)


def found_pairs(mesh: SurfaceMesh, distance: torch.Tensor, found: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return spheres (N,) and triangles (N,) of contacts."""
    sphere, slot = torch.isfinite(distance).nonzero(as_tuple=True)
    return sphere.numpy(), (found[sphere, slot] // FEATURES).numpy()


def _beside(mesh: SurfaceMesh, triangle: np.ndarray, places: np.ndarray, reach: float) -> np.ndarray:
    """Return whether places (N, 3) are beside triangles (N,), as `is_beside` of the kernel."""
    corners, prism = mesh.topology.corners[triangle], mesh.topology.prisms[triangle]
    arm, second = places - corners[:, 0], places - corners[:, 1]
    height = (arm * prism[:, :3]).sum(1)
    below, slack = (height < 0).astype(int), 1e-5 * reach
    most, open_ = (prism[np.arange(len(prism)), start + below] for start in (12, 14))
    arms = np.stack((arm, second, arm), 1)
    out = (arms * prism[:, 3:12].reshape(-1, 3, 3)).sum(-1)
    open_ = open_.astype(int)[:, None] >> np.arange(3) & 1 > 0
    beyond = (~open_ & (out > (most * abs(height) + slack)[:, None])).any(1)
    return (abs(height) >= reach) | (beyond & (~open_ | (out < -slack)).all(1))
