"""Writes tiny wheels; a wheel of this file stands in for hatchling."""

import tomllib
import zipfile
from pathlib import Path


def write_wheel(folder, name, version, files, commands):
    """A wheel of ``files`` (name → text) with ``commands`` (name → ``module:function``)."""
    path = Path(folder) / f"{name}-{version}-py3-none-any.whl"
    info = f"{name}-{version}.dist-info"
    lines = "".join(f"{command} = {entry}\n" for command, entry in commands.items())
    with zipfile.ZipFile(path, "w") as wheel:
        for file, text in files.items():
            wheel.writestr(file, text)
        wheel.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        wheel.writestr(
            f"{info}/WHEEL", "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        wheel.writestr(f"{info}/entry_points.txt", f"[console_scripts]\n{lines}")
        wheel.writestr(f"{info}/RECORD", "")
    return path


def build_editable(wheel_directory, config_settings=None, metadata_directory=None):
    """What pip asks a build backend for, in the project's folder."""
    project = tomllib.loads(Path("pyproject.toml").read_text())["project"]
    name = project["name"].replace("-", "_")
    path = {f"{name}.pth": f"{Path.cwd()}\n"}
    return write_wheel(wheel_directory, name, project["version"], path, project["scripts"]).name
