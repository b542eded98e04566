# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
"""Joints of an arm from MJCF: MuJoCo compiles the description, and the model is walked by index from tip to base."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, cast

import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.descriptions import HANDLED, Source, file_or_text, make_joint
from torchdyn_plan.kinematics.joint import Coupling, Joint, Kind, held, motion, rotation_about, transform

if TYPE_CHECKING:
    import mujoco

    MjcfSource: TypeAlias = Source | mujoco.MjSpec | mujoco.MjModel

WORLD = 0
"""Index of the world body."""
KINDS: dict[str, Kind] = {"hinge": "revolute", "slide": "prismatic"}
"""MJCF's names of joint types."""


def joints_of_mjcf(source: MjcfSource, *, base: str | None, tip: str) -> list[Joint]:
    """Joints from the body ``base`` (the world if None) to the body or site ``tip`` of the MJCF ``source``."""
    return _Scene(_compiled(source)).joints_between(base, tip)


def _compiled(source: MjcfSource) -> mujoco.MjModel:
    """The model of ``source``; other files are searched for in the description's folder."""
    mujoco = _mujoco()
    if isinstance(source, mujoco.MjModel):
        return source
    try:
        if isinstance(source, mujoco.MjSpec):
            return source.compile()
        given = file_or_text(source, "MJCF")
        if isinstance(given, (str, bytes)):
            return mujoco.MjModel.from_xml_string(given if isinstance(given, str) else given.decode())
        return mujoco.MjModel.from_xml_path(str(given))
    except InputError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())
        if "opening file" in reason:
            reason += " (files are searched for in the description's folder, if it is given as a path)"
        raise InputError(f"the MJCF text cannot be read: {reason}") from error


def _mujoco() -> Any:
    try:
        import mujoco
    except ImportError as error:
        raise InputError("MJCF is read by mujoco, which is not installed: pip install 'torchdyn-plan[sim]'") from error
    return mujoco


class _Scene:
    """A compiled model, in which bodies, joints and sites are identified by index."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.mujoco = model, _mujoco()
        self.bodies, self.sites = self._indices("body", model.nbody), self._indices("site", model.nsite)

    def name(self, kind: str, index: int) -> str:
        """Name of a body, joint, site or tendon; an unnamed one is called by its index, such as ``joint#3``."""
        type_ = getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        name = self.mujoco.mj_id2name(self.model, type_, index) or f"{kind}#{index}"
        if self.mujoco.mj_name2id(self.model, type_, name) in (-1, index):
            return name
        return f"{name} (unnamed)"

    def _indices(self, kind: str, count: int) -> dict[str, int]:
        return {self.name(kind, index): index for index in range(count)}

    def place(self, tip: str) -> tuple[int | None, int]:
        """The site of that name, or None, and its body; a site takes precedence over a body of the same name."""
        if tip in self.sites or (tip.startswith("site:") and tip not in self.bodies):
            site = self._index("site", tip)
            return site, int(self.model.site_bodyid[site])
        if tip not in self.bodies and not tip.startswith("body:"):
            check_choice("body or site", tip, {*self.bodies, *self.sites})
        return None, self._index("body", tip)

    def _index(self, kind: str, name: str) -> int:
        """Index of the body or site ``name``, which may be prefixed by its kind, such as ``site:tool``."""
        known = self.bodies if kind == "body" else self.sites
        plain = name if name in known else name.removeprefix(f"{kind}:")
        check_choice(kind, plain, known)
        return known[plain]

    def joints_between(self, base: str | None, tip: str) -> list[Joint]:
        """Joints from the body ``base`` to the body or site ``tip``."""
        site, body = self.place(tip)
        stop = WORLD if base is None else self._index("body", base)
        parts: list[list[Joint]] = []
        if site is not None:
            offset = _pose(self.model.site_pos[site], self.model.site_quat[site])
            parts.append([Joint(offset=offset, name=self.name("site", site))])
        while body != stop:
            if body == WORLD:
                raise InputError(f"{tip!r} does not hang from body {base!r}; choose a base nearer the root")
            parts.append(list(self._of_body(body)))
            body = int(self.model.body_parentid[body])
        return [joint for part in reversed(parts) for joint in part]

    def _of_body(self, body: int) -> Iterator[Joint]:
        """A body's pose in its parent, and its joints in order."""
        model, first = self.model, int(self.model.body_jntadr[body])
        yield Joint(offset=_pose(model.body_pos[body], model.body_quat[body]), name=self.name("body", body))
        for index in range(first, first + int(model.body_jntnum[body])):
            joint, anchor = self.alone(index), torch.from_numpy(model.jnt_pos[index].copy())
            back = motion(joint.kind, cast(Tensor, joint.axis), -self.reference(index))
            yield self._coupled(replace(joint, offset=transform(position=anchor) @ back), index)
            yield Joint(offset=transform(position=-anchor), name=joint.name)

    def reference(self, joint: int) -> float:
        """Position at which the model is drawn."""
        return float(self.model.qpos0[self.model.jnt_qposadr[joint]])

    def alone(self, joint: int) -> Joint:
        """A joint without its pose and its couplings."""
        model, name = self.model, self.name("joint", joint)
        kind = self.mujoco.mjtJoint(int(model.jnt_type[joint])).name.removeprefix("mjJNT_").lower()
        if kind not in KINDS:
            body = self.name("body", int(model.jnt_bodyid[joint]))
            raise InputError(
                f"the MJCF text has a joint of type {kind!r}; Arm handles {HANDLED}. It is {name!r} of the body "
                f"{body!r}: to do without, choose this body or one behind it as the base"
            )
        limits = model.jnt_range[joint].tolist() if bool(model.jnt_limited[joint]) else None
        axis = torch.from_numpy(model.jnt_axis[joint].copy())
        return make_joint(name, KINDS[kind], transform(), axis, limits=limits, speed=None)

    def _coupled(self, joint: Joint, index: int) -> Joint:
        """``joint`` with its driver, according to the equalities of the model."""
        ratio, shift, seen = 1.0, 0.0, [index]
        while seen[-1] in self.couplings:
            equality = self.couplings[seen[-1]]
            if isinstance(equality, str):
                raise InputError(f"joint {self.name('joint', seen[-1])!r} is coupled to others: {equality}")
            shift += ratio * equality.shift
            if equality.driver is None or equality.ratio == 0.0:
                return held(joint, shift)
            ratio *= equality.ratio
            if equality.driver in seen:
                names = ", ".join(repr(self.name("joint", one)) for one in seen)
                raise InputError(f"the joints {names} are coupled in a circle")
            seen.append(equality.driver)
        if len(seen) == 1:
            return joint
        return replace(joint, coupling=Coupling(driver=self.alone(seen[-1]), ratio=ratio, shift=shift))

    @cached_property
    def couplings(self) -> dict[int, Equality | str]:
        """The coupling of each coupled joint, or why it is not supported."""
        model, found = self.model, {}
        for index in range(model.neq):
            if not model.eq_active0[index]:
                continue
            for joint, equality in self._equalities(index):
                found[joint] = "by more than one equality" if joint in found else equality
        return found

    def _equalities(self, index: int) -> Iterator[tuple[int, Equality | str]]:
        """The joints that an equality of joints or tendons moves, and how."""
        model, types = self.model, self.mujoco.mjtEq
        kind, ends = int(model.eq_type[index]), (int(model.eq_obj1id[index]), int(model.eq_obj2id[index]))
        constant, slope, *curve = model.eq_data[index, :5].tolist()
        if kind == types.mjEQ_JOINT:
            first, second = ends
            if second < 0:
                yield first, Equality(None, 0.0, self.reference(first) + constant)
            elif any(curve):
                yield first, "by a polynomial, and Arm handles linear couplings only"
            else:
                shift = self.reference(first) + constant - slope * self.reference(second)
                yield first, Equality(second, slope, shift)
        elif kind == types.mjEQ_TENDON:
            yield from self._of_tendons(ends, constant, slope, curved=any(curve))

    def _of_tendons(
        self, ends: tuple[int, int], constant: float, slope: float, *, curved: bool
    ) -> Iterator[tuple[int, Equality | str]]:
        """`_equalities` for the lengths of one tendon or two: Σ weight · q = constant."""
        weights: dict[int, float] = {}
        for tendon, factor in zip(ends, (1.0, -slope), strict=True):
            if tendon < 0:
                continue
            constant += factor * float(self.model.tendon_length0[tendon])
            for joint, weight in self._joints_of(tendon):
                weights[joint] = weights.get(joint, 0.0) + factor * weight
        weights = {joint: weight for joint, weight in weights.items() if weight != 0.0}
        tendons = " and ".join(repr(self.name("tendon", tendon)) for tendon in ends if tendon >= 0)
        if curved or len(weights) > 2 or any(math.isnan(weight) for weight in weights.values()):
            for joint in weights:
                yield joint, f"by the tendon {tendons}, and Arm handles linear couplings of two joints only"
        elif weights:
            joint, weight = weights.popitem()
            ratio = -next(iter(weights.values()), 0.0) / weight
            yield joint, Equality(next(iter(weights), None), ratio, constant / weight)

    def _joints_of(self, tendon: int) -> Iterator[tuple[int, float]]:
        """The joints that determine a tendon's length, and their weights; NaN if the length is not a sum of joints."""
        model, wraps = self.model, self.mujoco.mjtWrap
        first = int(model.tendon_adr[tendon])
        for index in range(first, first + int(model.tendon_num[tendon])):
            kind, what = int(model.wrap_type[index]), int(model.wrap_objid[index])
            if kind == wraps.mjWRAP_JOINT:
                yield what, float(model.wrap_prm[index])
            elif kind != wraps.mjWRAP_PULLEY:
                bodies = model.site_bodyid if kind == wraps.mjWRAP_SITE else model.geom_bodyid
                body = int(bodies[what])
                while body != WORLD:
                    start = int(model.body_jntadr[body])
                    yield from ((joint, math.nan) for joint in range(start, start + int(model.body_jntnum[body])))
                    body = int(model.body_parentid[body])


class Equality(NamedTuple):
    """A joint's position is ``ratio · q + shift``, with q the position of another, or ``shift`` without another."""

    driver: int | None
    ratio: float
    shift: float


def _pose(position: Any, quaternion: Any) -> Tensor:
    """Transform ``(4, 4)`` float64 of a position ``(3,)`` and a quaternion wxyz ``(4,)``."""
    return transform(_rotation_of_quaternion(quaternion), position)


def _rotation_of_quaternion(quaternion: Any) -> Tensor:
    """Rotation ``(3, 3)`` of a quaternion wxyz."""
    w, x, y, z = (torch.as_tensor(quaternion.copy()) / math.hypot(*quaternion)).tolist()
    vector = torch.tensor([x, y, z], dtype=torch.float64)
    angle = 2.0 * math.atan2(float(vector.norm()), w)
    axis = vector / vector.norm() if float(vector.norm()) > 0.0 else vector
    return rotation_about(axis, angle)
