"""Chains of any tree: what the engine and the kernel derive from the parents of links, beside walks along the tree."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.pipeline.physics.chains.chain import Chain, Joint
from cgwm.pipeline.physics.chains.joint_command import JointCommand
from cgwm.pipeline.physics.chains.joint_rows import OPEN_SPEED, JointRows
from cgwm.pipeline.physics.chains.state import with_joints
from cgwm.pipeline.physics.fused.tree import JOINT_COLUMNS, LINK_COLUMNS, Tree, columns, lists_bytes, tree_of
from cgwm.pipeline.physics.world import World
from helpers.chains import chained, link, still
from helpers.worlds import F64, ball_body, batch
from scipy.spatial.transform import Rotation

PARENTS = {"c": "b", "a": "root", "b": "root", "f": "c", "d": "a", "e": "c", "g": "d", "h": "d"}
"""Links of a tree by the order of its joints, in which generations are mixed, with their parents."""
KINDS = {"c": "slide", "a": "fixed", "b": "hinge", "f": "hinge", "d": "hinge", "e": "fixed", "g": "fixed", "h": "slide"}
ORDER = ("b", "c", "a", "f", "d", "e", "h", "g")


def tree(prefix: str, base: str, rng: np.random.Generator) -> Chain:
    joints = tuple(
        Joint.of(
            f"{prefix}j_{name}", KINDS[name], prefix + name, prefix + PARENTS[name],
            position_m=tuple(rng.normal(size=3)), quat_wxyz=tuple(rng.normal(size=4)), axis=tuple(rng.normal(size=3)),
        )
        for name in ORDER
    )  # fmt: skip
    return Chain(name=f"{prefix}tree", root=f"{prefix}root", base=base, joints=joints)


def two_trees() -> World:
    """A fixed tree, of which the links d, g and h have no mass, a ball and a free tree."""
    rng = np.random.default_rng(0)
    chains = (tree("x", "fixed", rng), tree("y", "free", rng))
    bodies = [link("xroot", 0.0), link("yroot", 0.3)]
    for prefix in "xy":
        for name in "hgfedcba":
            body = link(prefix + name, 0.1)
            if prefix == "x" and name in "aeg":
                body = replace(body, mass=0 * body.mass, inertia=0 * body.inertia)
            bodies.append(body)
    bodies.insert(3, ball_body(0.02))
    return chained(chains, *bodies)


def ancestors(chain: Chain, name: str) -> list[str]:
    """Return the links from the root to a link, both included."""
    parents = {joint.link: joint.parent for joint in chain.joints}
    found = [name]
    while found[0] in parents:
        found.insert(0, parents[found[0]])
    return found


def test_a_chain_knows_its_generations_branches_and_what_moves_each_link() -> None:
    for chain in two_trees().chains:
        kinds = {joint.link: joint for joint in chain.joints}
        paths = {name: ancestors(chain, name) for name in chain.links}
        moved = {name: [kinds[k].name for k in path[1:] if kinds[k].kind != "fixed"] for name, path in paths.items()}
        for place, name in enumerate(chain.links):
            assert chain.parents[place] == (-1 if place == 0 else chain.links.index(paths[name][-2]))
            row = [joint for joint, above in zip(chain.joint_names, chain.above[place], strict=True) if above]
            assert sorted(row) == sorted(moved[name])
            firsts = [k for k in paths[name][1:] if kinds[k].kind != "fixed"]
            first = chain.links.index(firsts[0]) if firsts and chain.base != "free" else 0
            assert chain.branches[place] == first
            assert chain.moves(name) is (chain.base == "free" or bool(moved[name]))
        order = [0, *(k for row in chain.generations for k in row.links.tolist())]
        for depth, row in enumerate(chain.generations, 1):
            assert sorted(row.links.tolist()) == [
                k for k, name in enumerate(chain.links) if len(paths[name]) == depth + 1
            ]
            for k, joint, above in zip(row.links.tolist(), row.joints.tolist(), row.above.tolist(), strict=True):
                assert chain.joints[joint].link == chain.links[k] and order[above] == chain.parents[k]
        assert [order[k] for k in chain.generation_order.tolist()] == list(range(len(chain.links)))


def test_poses_of_links_are_those_of_their_parents_moved_by_their_joints() -> None:
    rng = np.random.default_rng(1)
    for chain in two_trees().chains:
        count = 3
        values = torch.as_tensor(rng.normal(size=(count, len(chain.moving))))
        position, quat = torch.as_tensor(rng.normal(size=(count, 3))), torch.as_tensor(rng.normal(size=(count, 4)))
        quat = quat / quat.norm(dim=-1, keepdim=True)
        places, turns = chain.poses(position, quat, values)
        for row in range(count):
            found = {chain.root: (position[row].numpy(), Rotation.from_quat(quat[row].numpy(), scalar_first=True))}
            waiting = list(chain.joints)
            while waiting:
                joint = next(one for one in waiting if one.parent in found)
                waiting.remove(joint)
                origin, turn = found[joint.parent]
                own = Rotation.from_quat(joint.quat_wxyz[0].numpy(), scalar_first=True)
                value = float(values[row, chain.joint_names.index(joint.name)]) if joint.kind != "fixed" else 0.0
                axis = joint.axis[0].numpy()
                shift = axis * value if joint.kind == "slide" else 0 * axis
                bend = Rotation.from_rotvec(axis * value if joint.kind == "hinge" else 0 * axis)
                at = origin + turn.apply(joint.position[0].numpy() + own.apply(shift))
                found[joint.link] = (at, turn * own * bend)
            for k, name in enumerate(chain.links):
                np.testing.assert_allclose(places[row, k], found[name][0], atol=1e-12)
                np.testing.assert_allclose(
                    Rotation.from_quat(turns[row, k].numpy(), scalar_first=True).as_matrix(),
                    found[name][1].as_matrix(),
                    atol=1e-12,
                )


def rows_of(found: Tree, start: str, name: str) -> list[list[int]]:
    edges = list(found.lists[start])
    assert edges[0] == 0 and edges[-1] == len(found.lists[name])
    return [list(found.lists[name][a:b]) for a, b in itertools.pairwise(edges)]


def test_the_kernel_walks_along_the_tree_as_its_lists_say() -> None:
    world = two_trees()
    found, names = tree_of(world, 2, [1]), world.body_names
    links = [name for chain in world.chains for name in chain.links]
    chain_of = [number for number, chain in enumerate(world.chains) for _ in chain.links]
    joints = {joint.link: joint for chain in world.chains for joint in chain.joints}
    paths = [[links.index(one) for one in ancestors(world.chains[c], n)] for c, n in zip(chain_of, links, strict=True)]
    kinds = [
        {"fixed": 0, "free": 1}[world.chains[c].base]
        if n not in joints
        else {"hinge": 2, "slide": 3, "fixed": 4}[joints[n].kind]
        for c, n in zip(chain_of, links, strict=True)
    ]
    sizes = [{1: 6, 2: 1, 3: 1}.get(kind, 0) for kind in kinds]
    first = np.concatenate([[0], np.cumsum(sizes)]).tolist()
    above = [[dof for k in path for dof in range(first[k], first[k] + sizes[k])] for path in paths]
    dof_link = [k for k, size in enumerate(sizes) for _ in range(size)]
    dof_above = [[d for d in above[dof_link[dof]] if d <= dof] for dof in range(len(dof_link))]
    moving = [k for k, kind in enumerate(kinds) if kind in (2, 3)]

    assert list(found.bodies) == [names.index(name) for name in links]
    assert list(found.parents) == [path[-2] if len(path) > 1 else -1 for path in paths]
    assert list(found.kinds) == kinds
    assert list(found.dofs) == [first[k] if sizes[k] else -1 for k in range(len(links))]
    assert [list(row) for row in found.above] == above and list(found.dof_links) == dof_link
    assert [list(row) for row in found.dof_above] == dof_above
    assert list(found.joints) == [moving.index(k) if k in moving else -1 for k in range(len(links))]
    assert list(found.joint_dofs) == [first[k] for k in moving]
    assert list(found.commands) == [-1, 2] and found.heavy
    assert list(found.roots) == [paths[k][0] for k in (0, len(world.chains[0].links))]
    joint_chain = [chain_of[k] for k in moving]
    assert list(found.firsts) == [joint_chain.index(0), joint_chain.index(1)]
    assert list(found.counts) == [joint_chain.count(0), joint_chain.count(1)]
    massless = {links.index(f"x{name}") for name in "aeg"}
    light = [
        k in massless
        and kinds[k] == 4
        and all(j in massless and kinds[j] == 4 for j, path in enumerate(paths) if k in path)
        for k in range(len(links))
    ]
    assert [bool(one) for one in found.light] == light and sum(light) == 2  # what hangs on a has a mass

    every, depths = range(len(links)), [len(path) for path in paths]
    assert found.levels == max(depths) and found.depth == max(map(len, above)) and found.columns == sum(map(len, above))
    assert rows_of(found, "level_start", "level_link") == [
        [k for k in every if depths[k] == level + 1] for level in range(max(depths))
    ]
    assert rows_of(found, "child_start", "link_child") == [
        [j for j in reversed(every) if len(paths[j]) > 1 and paths[j][-2] == k and not light[j]] for k in every
    ]
    dofs = range(len(dof_link))
    assert rows_of(found, "rank_start", "rank_dof") == [
        [d for d in dofs if len(dof_above[d]) == rank + 1] for rank in range(max(map(len, dof_above)))
    ]
    assert rows_of(found, "below_start", "dof_below") == [
        [d for d in dofs if d != dof and dof in dof_above[d]] for dof in dofs
    ]
    assert rows_of(found, "moved_start", "moved_link") == [[k for k in every if dof in above[k]] for dof in dofs]
    assert rows_of(found, "column_start", "column_link") == [[k] * len(above[k]) for k in every]
    branches = rows_of(found, "branch_start", "branch_joint")
    assert sorted(joint for row in branches for joint in row) == list(range(len(moving)))
    for one in range(len(moving)):
        for other in range(len(moving)):
            together = any(one in row and other in row for row in branches)
            assert together == bool(set(dof_above[first[moving[one]]]) & set(dof_above[first[moving[other]]]))
    padded = np.reshape(found.lists["link_above"], (len(links), -1))
    assert all(padded[k, : len(above[k])].tolist() == above[k] and not padded[k, len(above[k]) :].any() for k in every)
    padded = np.reshape(found.lists["dof_above"], (len(dof_link), -1))
    assert all(padded[d, : len(dof_above[d])].tolist() == dof_above[d] for d in dofs)
    assert list(found.lists["link_root"]) == [path[0] for path in paths]
    assert list(found.lists["link_chain"]) == chain_of and list(found.lists["joint_chain"]) == joint_chain
    assert list(found.lists["dof_joint"]) == [moving.index(k) if k in moving else -1 for k in dof_link]
    assert list(found.lists["link_depth"]) == list(map(len, above)) and list(found.lists["dof_depth"]) == list(
        map(len, dof_above)
    )

    free = [body.motion == "free" for body in world.bodies]
    groups = found.groups(free)
    for body, name in enumerate(names):
        if name == "ball":
            assert groups[body] == body
            continue
        path = [k for k in paths[links.index(name)] if sizes[k]]
        assert groups[body] == (names.index(links[path[0]]) if path else -1)
    state = with_joints(world, still(len(names)), {"xj_b": 0.3}, {"yj_h": -0.2})
    parts = columns(world, state)
    assert sum(part.shape[-1] for part in parts) == found.table_width
    assert found.table_width == LINK_COLUMNS * len(links) + JOINT_COLUMNS * len(moving)
    values = torch.cat([part.reshape(1, -1, JOINT_COLUMNS)[..., -2:] for part in parts[2:]], 1)[0]
    assert values[moving.index(links.index("xb"))].tolist() == pytest.approx([0.3, 0.0])
    assert values[moving.index(links.index("yh"))].tolist() == pytest.approx([0.0, -0.2])
    table = parts[0].reshape(len(world.chains[0].links), LINK_COLUMNS)
    for row, name in zip(table, world.chains[0].links, strict=True):
        body, joint = world.bodies[names.index(name)], joints.get(name)
        place = [[0, 0, 0], [1, 0, 0, 0], [0, 0, 0]] if joint is None else [joint.position, joint.quat_wxyz, joint.axis]
        inertia = body.inertia[0][[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        wanted = [*(torch.as_tensor(one).flatten().double() for one in place), body.mass, inertia, body.com[0]]
        torch.testing.assert_close(row, torch.cat(wanted))


@pytest.mark.parametrize("most", [-129, -128, 127, 128, -32769, -32768, 32767, 32768])
def test_a_list_takes_the_smallest_type_that_holds_its_numbers(most: int) -> None:
    size = next(
        np.dtype(kind).itemsize for kind in ("i1", "i2", "i4") if np.iinfo(kind).min <= most <= np.iinfo(kind).max
    )
    assert lists_bytes({"one": [0, most, 5]}) == 3 * size + 3
    assert lists_bytes({"one": [0, most, 5], "none": []}) == 3 * size + 3 + 1 + 3  # an array has one place at least


def rows(target: tuple[float, float], friction: float, speed: float, count: int = 1) -> JointRows:
    """One joint of unit mass that moves alone, or several of one body."""
    return JointRows(
        body=0,
        rows=torch.eye(count, dtype=F64)[None],
        speed=torch.full((1, count), speed, dtype=F64),
        target=torch.tensor([[target] * count], dtype=F64),
        friction=torch.full((1, count), friction, dtype=F64),
        active=(True,) * count,
    )


@pytest.mark.parametrize("speed", [-2.0, 0.5, 3.0])
def test_limits_and_friction_of_a_joint_give_the_speed_that_they_ask_for(speed: float) -> None:
    """Repeated passes end where each impulse is 0, or the speed is the one that is asked for; none pulls."""
    cases = ((1.0, -OPEN_SPEED, 0.0), (-OPEN_SPEED, 1.0, 0.0), (-OPEN_SPEED, -OPEN_SPEED, 0.7), (1.0, -OPEN_SPEED, 0.2))
    for below, above, friction in cases:
        one = rows((below, above), friction, speed)
        impulses, moved = torch.zeros(1, 1, 3, dtype=F64), torch.zeros(1, 1, 1, dtype=F64)
        for _ in range(60):
            impulses, moved = one.solve(impulses, moved)
            torch.testing.assert_close(moved, one.motion(impulses))
        lower, upper, rubbed = impulses[0, 0].tolist()
        after = speed + lower - upper + rubbed
        assert lower >= 0 and upper >= 0 and abs(rubbed) <= friction + 1e-12
        assert lower * (after - below) == pytest.approx(0, abs=1e-9) and after >= below - 1e-9
        assert upper * (-after - above) == pytest.approx(0, abs=1e-9) and -after >= above - 1e-9
        assert rubbed * after <= 1e-9  # friction opposes what is left of the motion
        if abs(after) > 1e-9:
            assert abs(rubbed) == pytest.approx(friction)


def test_joints_that_act_on_each_other_are_solved_together() -> None:
    """Two joints with a mass matrix that couples them, both at their lower limit: both get the speed asked for."""
    root = torch.linalg.cholesky(torch.tensor([[2.0, 0.7], [0.7, 1.0]], dtype=F64))
    one = replace(rows((0.4, -OPEN_SPEED), 0.0, -1.0, 2), rows=root[None])
    impulses, moved = torch.zeros(1, 2, 3, dtype=F64), torch.zeros(1, 2, 1, dtype=F64)
    for _ in range(200):
        impulses, moved = one.solve(impulses, moved)
    after = one.speed[0] + (one.rows[0] @ moved[0])[:, 0]
    torch.testing.assert_close(after, torch.full((2,), 0.4, dtype=F64))
    torch.testing.assert_close(moved, one.motion(impulses))
    idle = replace(one, active=(True, False))
    impulses, moved = idle.solve(torch.zeros(1, 2, 3, dtype=F64), torch.zeros(1, 2, 1, dtype=F64))
    assert not impulses[0, 1].any() and bool(moved.any())


@pytest.mark.parametrize("hold", ["zero", "linear", "cubic"])
def test_targets_of_commanded_speeds_are_their_integral(hold: str) -> None:
    rng = np.random.default_rng(0)
    times = batch([0.0, 0.1, 0.25, 0.3])
    speeds = torch.as_tensor(rng.normal(size=(2, 4, 3)))
    start = torch.as_tensor(rng.normal(size=(1, 3)))
    command = JointCommand.speeds(times, speeds, start, hold)
    rates = JointCommand.targets(times, speeds, hold)
    torch.testing.assert_close(command.at(batch(0.0)), start.expand(2, -1))
    grid = np.linspace(0, 0.3, 601)
    rate = np.stack([rates.at(batch(t)).numpy() for t in grid[:-1] + 0.5 * np.diff(grid)])
    for index in (150, 300, 480, 600):
        wanted = start.numpy() + rate[:index].sum(0) * (grid[1] - grid[0])
        np.testing.assert_allclose(command.at(batch(grid[index])), wanted, atol=1e-6)
    torch.testing.assert_close(command.at(batch(9.0)), command.at(batch(0.3)))  # it stays where it ends


def test_pairs_are_what_can_touch() -> None:
    """What moves touches the ground and all others; links of one chain touch each other as it lists them."""
    world = two_trees()
    sphere = {"centers": torch.zeros(1, 1, 3, dtype=F64), "radii": torch.full((1, 1), 0.01, dtype=F64)}
    solid = ("xroot", "xa", "xf", "xh", "yroot", "yg", "ball")
    bodies = tuple(replace(body, **sphere) if body.name in solid else body for body in world.bodies)
    chains = (replace(world.chains[0], touching=(("xf", "xh"),), within=("xh",)), world.chains[1])
    names = [body.name for body in bodies]
    world = replace(world, bodies=bodies, chains=chains)
    found = {tuple("ground" if k < 0 else names[k] for k in pair) for pair in world.pairs}
    assert len(found) == len(world.pairs)
    moving = {"xf", "xh", "yroot", "yg", "ball"}  # no joint moves xa
    apart = {frozenset(pair) for pair in (("xf", "xh"),)}
    outer = [name for name in solid if name != "xh"]
    for one in outer:
        for other in outer:
            if one < other and {one, other} & moving and (one[0] != other[0] or "ball" in (one, other)):
                apart.add(frozenset((one, other)))
    assert {frozenset(pair) for pair in found if "ground" not in pair} == apart
    assert all(pair[0] in moving for pair in found)
    assert {pair[0] for pair in found if "ground" in pair} == moving - {"xh"}
    assert replace(world, touching=False).pairs == []
