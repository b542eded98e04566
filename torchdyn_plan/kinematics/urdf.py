"""Joints of an arm from URDF.

Only the joints between base and tip are read, and those that they mimic, so that errors in parts an arm does not need
do not matter: transmissions, materials, meshes, inertias, plugins, other joints. These joints are passed to the parser
of pytorch-kinematics; its chains would round their offsets to float32.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.descriptions import HANDLED, Source, file_or_text, make_joint
from torchdyn_plan.kinematics.joint import Coupling, Joint, Kind, held, rotation_about, transform

MOVING = "revolute", "continuous", "prismatic"


class _Robot(NamedTuple):
    """The links and joints of a text."""

    links: Counter[str]
    """How often each name is declared."""
    joints: list[Element]
    by_child: dict[str, list[Element]]
    """The joints that lead to a link."""


def joints_of_urdf(source: Source, *, base: str | None, tip: str) -> list[Joint]:
    """Joints from the link ``base`` (the root if None) to the link ``tip`` of the URDF ``source``."""
    from pytorch_kinematics.urdf_parser_py.urdf import URDF

    robot = _robot(_parsed(source))
    path = _path(robot, base, tip)
    parsed: Any = URDF.from_xml_string(_text([*path, *_drivers(robot, path)])).joint_map
    return [_joint(parsed, _name(joint)) for joint in path]


def _parsed(source: Source) -> Element:
    """Root of the XML; names are taken literally, so that prefixes need not be declared."""
    given = file_or_text(source, "URDF")
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    try:
        parser.Parse(given if isinstance(given, (str, bytes)) else given.read_bytes(), True)
    except (expat.ExpatError, OSError, ValueError) as error:
        raise InputError(f"the URDF text cannot be read: {error}") from error
    root = builder.close()
    if root.tag != "robot":
        raise InputError(f"the URDF text cannot be read: its root is <{root.tag}>, not <robot>")
    macros = [child.tag for child in root if child.tag.startswith("xacro:")]
    if macros:
        raise InputError(f"the URDF text holds the macro <{macros[0]}>: expand it first, by the program xacro")
    return root


def _robot(root: Element) -> _Robot:
    if root.find("link") is None:
        raise InputError("the URDF text declares no link")
    joints, by_child = root.findall("joint"), {}
    for joint in joints:
        by_child.setdefault(_end(joint, "child"), []).append(joint)
    return _Robot(Counter(link.get("name", "") for link in root.findall("link")), joints, by_child)


def _name(joint: Element) -> str:
    return joint.get("name", "")


def _end(joint: Element, which: str) -> str:
    """The link at an end of a joint, "parent" or "child"."""
    element = joint.find(which)
    link = None if element is None else element.get("link")
    if link is None:
        raise InputError(f"joint {_name(joint)!r} names no {which} link")
    return link


def _path(robot: _Robot, base: str | None, tip: str) -> list[Element]:
    """The joints from ``base`` to ``tip``, checked."""
    for link in (tip,) if base is None else (tip, base):
        if link not in robot.links and link in robot.by_child:
            raise _undeclared(robot.by_child[link][0], link)
        check_choice("link", link, robot.links)
    path: list[Element] = []
    while tip != base and tip in robot.by_child:
        joint, *others = robot.by_child[tip]
        if joint in path:
            raise InputError(f"the joints {_listed(map(_name, path))} form a loop")
        if others:
            raise InputError(f"the joints {_listed(map(_name, (joint, *others)))} all lead to the link {tip!r}")
        path.append(joint)
        tip = _end(joint, "parent")
        if tip not in robot.links:
            raise _undeclared(joint, tip)
    if base is not None and tip != base:
        end = _end(path[0], "child") if path else tip
        raise InputError(f"link {end!r} does not hang from link {base!r}; choose a base nearer the root")
    for joint in path:
        _check(joint, robot)
    return path[::-1]


def _undeclared(joint: Element, link: str) -> InputError:
    return InputError(f"joint {_name(joint)!r} names the link {link!r}, which the text does not declare")


def _check(joint: Element, robot: _Robot) -> None:
    """Raise `InputError` unless ``joint`` can be a joint of an arm."""
    name, link, kind = _name(joint), _end(joint, "child"), joint.get("type")
    if not name:
        raise InputError(f"the joint that leads to the link {link!r} has no name")
    if robot.links[link] > 1:
        raise InputError(f"the link {link!r} is declared {robot.links[link]} times")
    named = [other for other in robot.joints if _name(other) == name]
    if len(named) > 1:
        links = _listed(_end(other, "child") for other in named)
        raise InputError(f"{len(named)} joints are named {name!r}: those that lead to the links {links}")
    if kind not in (*MOVING, "fixed"):
        raise InputError(
            f"the URDF text has a joint of type {kind!r}; Arm handles {HANDLED}. It is {name!r}: to do "
            f"without, choose the link {link!r} or one behind it as the base"
        )


def _drivers(robot: _Robot, path: Sequence[Element]) -> list[Element]:
    """The joints that those of ``path`` mimic, and those that these mimic in turn, checked."""
    drivers: list[Element] = []
    for joint in path:
        followers = [joint]
        while followers[-1].get("type") != "fixed" and (mimic := followers[-1].find("mimic")) is not None:
            follower, name = _name(followers[-1]), mimic.get("joint")
            found = [other for other in robot.joints if _name(other) == name]
            if len(found) != 1 or found[0].get("type") not in MOVING:
                what = f"{len(found)} joints have this name" if len(found) != 1 else "it is no joint that moves"
                raise InputError(f"joint {follower!r} mimics joint {name!r}, but {what}")
            if found[0] in followers:
                raise InputError(f"the joints {_listed(map(_name, followers))} mimic each other in a circle")
            followers += found
        drivers += (driver for driver in followers[1:] if driver not in (*path, *drivers))
    return drivers


def _text(joints: Iterable[Element]) -> bytes:
    """URDF of these joints, and of nothing else."""
    root = Element("robot", name="arm")
    for joint in joints:
        copy = Element("joint", name=_name(joint), type=joint.get("type", ""))
        copy.extend(Element(end, link=_end(joint, end)) for end in ("parent", "child"))
        copy.extend(list(_parts(joint)))
        root.append(copy)
    return ElementTree.tostring(root)


def _parts(joint: Element) -> Iterator[Element]:
    """What a joint is made of, its numbers checked."""
    origin, axis, limit, mimic = map(joint.find, ("origin", "axis", "limit", "mimic"))
    if origin is not None:
        if origin.get("quat_xyzw") is not None:
            raise InputError(f"joint {_name(joint)!r} has an origin in quat_xyzw, which is not read: give its rpy")
        yield Element("origin", {key: _numbers(joint, origin, key, "0 0 0") for key in ("xyz", "rpy")})
    if joint.get("type") == "fixed":
        return
    yield Element("axis", xyz="1 0 0" if axis is None else _numbers(joint, axis, "xyz", "1 0 0"))
    if limit is not None:
        names = "lower", "upper", "velocity"
        yield Element("limit", {"effort": "0"} | {key: _numbers(joint, limit, key, "0") for key in names})
    if mimic is not None:
        factors = {
            "multiplier": _numbers(joint, mimic, "multiplier", "1"),
            "offset": _numbers(joint, mimic, "offset", "0"),
        }
        yield Element("mimic", {"joint": mimic.get("joint", "")} | factors)


def _numbers(joint: Element, element: Element, attribute: str, default: str) -> str:
    """An attribute of as many finite numbers as its default has; limits may be infinite."""
    text = element.get(attribute, "").strip() or default
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    bad = math.isnan if element.tag == "limit" else lambda value: not math.isfinite(value)
    if len(values) != len(default.split()) or any(map(bad, values)):
        count = len(default.split())
        wanted = f"{count} finite numbers" if count > 1 else "a number"
        raise InputError(f"joint {_name(joint)!r} has {attribute}={text!r} in its <{element.tag}>, not {wanted}")
    return text


def _joint(parsed: dict[str, Any], name: str) -> Joint:
    """The joint of that name, coupled to another one where it mimics it: q = multiplier · q of the other + offset."""
    joint = _alone(parsed[name])
    ratio, shift, last = 1.0, 0.0, parsed[name]
    while last.mimic is not None and joint.kind != "fixed":
        ratio, shift = ratio * last.mimic.multiplier, shift + ratio * last.mimic.offset
        last = parsed[last.mimic.joint]
    if last is parsed[name]:
        return joint
    if ratio == 0.0:
        return held(joint, shift)
    return replace(joint, coupling=Coupling(driver=_alone(last), ratio=ratio, shift=shift))


def _alone(joint: Any) -> Joint:
    """A joint as the parser has it, without what it mimics; one of kind continuous turns without end."""
    from pytorch_kinematics.urdf import JOINT_TYPE_MAP

    kind, limit = cast(Kind, JOINT_TYPE_MAP[joint.type]), joint.limit
    limits = None if limit is None or joint.type == "continuous" else (limit.lower, limit.upper)
    speed = None if limit is None else limit.velocity
    return make_joint(joint.name, kind, _origin(joint.origin), joint.axis, limits=limits, speed=speed)


def _origin(origin: Any) -> Tensor:
    """Transform of a URDF origin: fixed-axis roll, pitch, yaw."""
    if origin is None:
        return transform()
    axes = torch.eye(3, dtype=torch.float64)
    roll, pitch, yaw = (rotation_about(axis, angle) for axis, angle in zip(axes, origin.rpy, strict=True))
    return transform(yaw @ pitch @ roll, origin.xyz)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(map(repr, names))
