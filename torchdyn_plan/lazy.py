"""Packages whose public names are imported when they are first used."""

from __future__ import annotations

import sys

# Importing typing for this constant would cost more than all the rest; type checkers know it by its name.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


def lazy_names(
    package: str, homes: dict[str, tuple[str, ...]], packages: tuple[str, ...] = ()
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """The functions ``__getattr__`` and ``__dir__`` (PEP 562) of a package that imports its names on first use.

    No name may be that of a submodule: importing the submodule would put the module in its place.

    Args:
        package: ``__name__`` of the package.
        homes: dotted names of modules inside the package, and the names that each of them defines.
        packages: packages inside it, which are found without an import of their own, too.
    """
    module_of = {name: module for module, names in homes.items() for name in names}

    def __getattr__(name: str) -> Any:  # noqa: N807
        from importlib import import_module

        if name in packages:
            return import_module(f"{package}.{name}")
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}", name=name, obj=sys.modules[package])
        value = getattr(import_module(f"{package}.{module_of[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    def __dir__() -> list[str]:  # noqa: N807
        return sorted({*vars(sys.modules[package]), *module_of, *packages})

    return __getattr__, __dir__
