"""Descriptions of robots as packages ship them, URDF and MJCF: which are read, and how far pose and Jacobian are off.

The references are MuJoCo for MJCF and pinocchio for URDF. Several tips of every file are read: the ends of its longest
chains, and others evenly between. If the chain contains an unsupported joint (a free one), the base is the body after
it, as the error suggests. A file that the reference cannot read either is refused, and its row has the error.

pip install pin example-robot-data gymnasium-robotics robosuite robosuite_models dm_control gym-aloha dexmate-urdf
python benchmarks/descriptions.py --out benchmarks/results/descriptions.json
"""

from __future__ import annotations

import dataclasses
import importlib.util
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import mujoco
import numpy as np
import torch
import tyro
from study import Output, Row, Study, each, measuring

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm

PACKAGES = (
    "torchdyn_plan",
    "example-robot-data",
    "dexmate_urdf",
    "robosuite",
    "robosuite_models",
    "gymnasium_robotics",
    "gym_aloha",
    "dm_control",
    "metaworld",
    "torchrl",
)
SCALAR = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
CONFIGURATIONS = 8
"""Random joint positions at which each tip is compared."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Measure."""

    packages: tuple[str, ...] = PACKAGES
    """Packages whose files are read, where they are installed."""
    files: int = 60
    """Most files of each package, evenly out of all."""
    tips: int = 8
    """Most tips of each file."""


class Reference(NamedTuple):
    """A description as another library has it."""

    tips: list[tuple[str, str | None]]
    """Tips, the longest chains first, each with the base that it takes, None for the root."""
    evaluate: Callable[[str, str | None, Mapping[str, float]], tuple[np.ndarray, np.ndarray]]
    """Pose ``(4, 4)`` of a tip in its base, and Jacobian ``(6, N)``, at positions of joints by name."""


def relative(pose: np.ndarray, jacobian: np.ndarray, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A pose and a Jacobian of the world's, in the frame ``base``."""
    turn = np.kron(np.eye(2), base[:3, :3].T)
    return np.linalg.inv(base) @ pose, turn @ jacobian


def matrix(rotation: Any, place: Any) -> np.ndarray:
    """A homogeneous transform."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.reshape(rotation, (3, 3)), place
    return pose


def of_mujoco(model: mujoco.MjModel) -> Reference:
    """A model of MuJoCo; free and ball joints stay where the model has them.

    Joints that equalities of joints and tendons couple to those given are brought to where MuJoCo's own constraints
    are kept, by Newton's method; their motion is that which keeps them.
    """
    data, model.opt.jacobian = mujoco.MjData(model), int(mujoco.mjtJacobian.mjJAC_DENSE)
    hinges = {label(model, "joint", i): i for i in range(model.njnt) if int(model.jnt_type[i]) in SCALAR}

    def evaluate(tip: str, base: str | None, positions: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        data.qpos[:] = model.qpos0
        given = [hinges[name] for name in positions]
        data.qpos[model.jnt_qposadr[given]] = list(positions.values())
        motion = np.zeros((model.nv, len(positions)))
        motion[model.jnt_dofadr[given]] = np.eye(len(positions))
        free = np.setdiff1d([model.jnt_dofadr[joint] for joint in hinges.values()], model.jnt_dofadr[given])
        for _ in range(3):
            residual, slope = kept_equalities(model, data)
            if not len(residual):
                break
            inverse = np.linalg.pinv(slope[:, free])
            data.qpos[model.jnt_qposadr[model.dof_jntid[free]]] -= inverse @ residual
            motion[free] = -inverse @ slope[:, model.jnt_dofadr[given]]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        linear, angular = np.zeros((2, 3, model.nv))
        kind, name = tip.split(":", 1)
        index = found(model, kind, name)
        if kind == "site":
            pose = matrix(data.site_xmat[index], data.site_xpos[index])
            mujoco.mj_jacSite(model, data, linear, angular, index)
        else:
            pose = matrix(data.xmat[index], data.xpos[index])
            mujoco.mj_jacBody(model, data, linear, angular, index)
        root = 0 if base is None else found(model, "body", base)
        return relative(pose, np.concatenate([linear, angular]) @ motion, matrix(data.xmat[root], data.xpos[root]))

    return Reference(tips_of_model(model), evaluate)


def kept_equalities(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """By how much the equalities of joints and tendons are missed, ``(E,)``, and the slopes ``(E, nv)`` of that."""
    mujoco.mj_fwdPosition(model, data)
    coupling = int(mujoco.mjtEq.mjEQ_JOINT), int(mujoco.mjtEq.mjEQ_TENDON)
    equalities = np.flatnonzero(data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY))
    rows = [row for row in equalities if int(model.eq_type[data.efc_id[row]]) in coupling]
    return data.efc_pos[rows].copy(), data.efc_J.reshape(-1, model.nv)[rows].copy()


def tips_of_model(model: mujoco.MjModel) -> list[tuple[str, str | None]]:
    """All sites, and bodies that bear no other, with joints between them and the base."""
    ends = [(f"site:{label(model, 'site', i)}", int(model.site_bodyid[i])) for i in range(model.nsite)]
    leaves = set(range(1, model.nbody)) - set(model.body_parentid.tolist())
    ends += [(f"body:{label(model, 'body', i)}", i) for i in sorted(leaves)]
    tips = []
    for tip, end in ends:
        body, joints, base = end, 0, None
        while body != 0 and base is None:
            own = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
            if any(int(model.jnt_type[joint]) not in SCALAR for joint in own):
                base = label(model, "body", body)
            else:
                joints, body = joints + len(own), int(model.body_parentid[body])
        if joints:
            tips.append((joints, tip, base))
    return [(tip, base) for _, tip, base in sorted(tips, key=lambda entry: -entry[0])]


def label(model: mujoco.MjModel, kind: str, index: int) -> str:
    """What `Arm` calls a body, joint or site."""
    return getattr(model, kind)(index).name or f"{kind}#{index}"


def found(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Index of a body or site that is called so."""
    count = model.nbody if kind == "body" else model.nsite
    return next(index for index in range(count) if label(model, kind, index) == name)


def of_pinocchio(file: Path) -> Reference:
    """A URDF file as pinocchio has it."""
    import pinocchio as pin  # pyright: ignore[reportMissingImports]

    model = pin.buildModelFromUrdf(str(file))
    data, root = model.createData(), ElementTree.fromstring(without_prefixes(file.read_text()))
    rules = {}
    for joint in root.findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None and model.existJointName(joint.get("name")):
            factors = float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
            rules[joint.get("name")] = mimic.get("joint"), *factors

    def evaluate(tip: str, base: str | None, positions: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        q, motion = pin.neutral(model), np.zeros((model.nv, len(positions)))
        values, slopes = dict(positions), dict(zip(positions, np.eye(len(positions)), strict=True))
        for name, (driver, ratio, shift) in 2 * list(rules.items()):
            if driver in values:
                values[name], slopes[name] = ratio * values[driver] + shift, ratio * slopes[driver]
        for name, value in values.items():
            joint = model.joints[model.getJointId(name)]
            q[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
            motion[joint.idx_v] = slopes[name]
        frame = model.getFrameId(tip, pin.FrameType.BODY)
        jacobian = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        pin.framesForwardKinematics(model, data, q)
        start = np.eye(4) if base is None else data.oMf[model.getFrameId(base, pin.FrameType.BODY)].homogeneous
        return relative(data.oMf[frame].homogeneous.copy(), jacobian @ motion, start)

    return Reference(tips_of_urdf(root), evaluate)


def without_prefixes(text: str) -> str:
    """The text with prefixes of names taken into the names, so that they need not be declared."""
    return re.sub(r"(</?|\s)([A-Za-z_][\w.-]*):([A-Za-z_][\w.-]*)(?=[\s=/>])", r"\1\2_\3", text)


def tips_of_urdf(root: ElementTree.Element) -> list[tuple[str, str | None]]:
    """The links that bear no other, with joints that move between them and the base."""
    ends = {joint.find("child").get("link"): joint for joint in root.findall("joint")}
    parents = {joint.find("parent").get("link") for joint in ends.values()}
    tips = []
    for tip in sorted(set(ends) - parents):
        link, joints, base = tip, 0, None
        while link in ends and base is None:
            kind = ends[link].get("type")
            if kind in ("floating", "planar", "spherical"):
                base = link
            else:
                joints, link = joints + (kind != "fixed"), ends[link].find("parent").get("link")
        if joints:
            tips.append((joints, tip, base))
    return [(tip, base) for _, tip, base in sorted(tips, key=lambda entry: -entry[0])]


def compare(source: Any, read: Callable[..., Arm], reference: Reference, arguments: Arguments) -> Row:
    """Some tips of one description, read and compared."""
    step = max(1, len(reference.tips) // arguments.tips)
    tips = reference.tips[::step][: arguments.tips]
    joints, pose_off, jacobian_off, refused = 0, 0.0, 0.0, {}
    for tip, base in tips:
        try:
            arm = read(source, tip=tip, base=base, dtype=torch.float64)
        except InputError as error:
            refused[tip] = str(error)
            continue
        joints = max(joints, arm.num_joints)
        lower, upper = arm.lower.clamp(-3.0, 3.0), arm.upper.clamp(-3.0, 3.0)
        generator = torch.Generator().manual_seed(0)
        share = torch.rand(CONFIGURATIONS, arm.num_joints, generator=generator, dtype=torch.float64)
        for q in lower + (upper - lower) * share:
            pose, jacobian = (value.numpy() for value in arm.pose_and_jacobian(q))
            expected = reference.evaluate(tip, base, dict(zip(arm.joint_names, q.tolist(), strict=True)))
            pose_off = max(pose_off, float(np.abs(pose - expected[0]).max()))
            jacobian_off = max(jacobian_off, float(np.abs(jacobian - expected[1]).max()))
    bases = sum(base is not None for _, base in tips)
    about = {"tips": len(tips), "read": len(tips) - len(refused), "behind_a_free_joint": bases, "most_joints": joints}
    return about | {"pose_off": pose_off, "jacobian_off": jacobian_off, "refused": refused}


def descriptions(package: str, most: int) -> Iterator[tuple[str, Any, Callable[..., Arm], Callable[[], Reference]]]:
    """Name, source, reader and reference of the descriptions of a package, as many as are asked for."""
    if package == "torchdyn_plan":
        model = TrapperScene().compile()
        yield "Trapper's scene", model, Arm.from_mjcf, partial(of_mujoco, model)
        return
    folder = folder_of(package)
    files = [] if folder is None else sorted(folder.rglob("*.urdf")) + sorted(filter(is_scene, folder.rglob("*.xml")))
    for index in np.unique(np.linspace(0, len(files) - 1, most).round().astype(int)) if files else ():
        file, name = files[index], str(files[index].relative_to(folder))
        if file.suffix == ".urdf":
            yield name, file, Arm.from_urdf, partial(of_pinocchio, file)
        else:
            yield name, file, Arm.from_mjcf, lambda file=file: of_mujoco(mujoco.MjModel.from_xml_path(str(file)))


def folder_of(package: str) -> Path | None:
    """Where an installed package has its files; None if it is not installed."""
    if package == "example-robot-data":
        folders = [Path(place) / "cmeel.prefix" / "share" / package / "robots" for place in sys.path]
        return next(filter(Path.is_dir, folders), None)
    found = importlib.util.find_spec(package)
    return None if found is None or found.origin is None else Path(found.origin).parent


def is_installed(package: str) -> bool:
    """Whether a package's files are here."""
    return package == "torchdyn_plan" or folder_of(package) is not None


def is_scene(file: Path) -> bool:
    """Whether a file is MJCF on its own, and not what others include."""
    text = file.read_text(errors="replace")
    return re.search(r"<mujoco[\s>]", text) is not None and "<worldbody" in text


def unreadable(source: Any, read: Callable[..., Arm], reason: Exception) -> Row:
    """How a description is refused that the reference cannot read, either."""
    try:
        read(source, tip="tool")
    except InputError as error:
        return {"no_reference": " ".join(str(reason).split())[:200], "refused": {"all": str(error)}}
    raise AssertionError(f"{source} was read, and the reference has {reason}")


def measure(
    source: Any, read: Callable[..., Arm], make_reference: Callable[[], Reference], arguments: Arguments
) -> Row:
    """The row of one description."""
    try:
        reference = make_reference()
    except (ValueError, RuntimeError) as error:
        return unreadable(source, read, error)
    return compare(source, read, reference, arguments)


def main(arguments: Arguments) -> None:
    """Read and compare them all."""
    study = Study(arguments)
    arguments = dataclasses.replace(arguments, packages=tuple(filter(is_installed, arguments.packages)))
    cases = [(package, *one) for package in arguments.packages for one in descriptions(package, arguments.files)]
    with measuring():
        for package, name, source, read, make_reference in each(cases, "descriptions"):
            about = {"package": package, "file": name, "most_tips": arguments.tips}
            study.row(about, partial(measure, source, read, make_reference, arguments))
    compared = [row for row in study.rows if "tips" in row and row["tips"] > 0]
    totals = {name: sum(row[name] for row in compared) for name in ("tips", "read")}
    worst = {name: max(row[name] for row in compared) for name in ("pose_off", "jacobian_off")}
    versions = {package: version(package) for package in arguments.packages}
    study.save(
        packages=versions, files=len(compared), without_reference=len(study.rows) - len(compared), **totals, **worst
    )


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
