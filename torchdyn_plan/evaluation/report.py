"""Results as one table for the eye."""

from collections.abc import Callable, Sequence

from torchdyn_plan.evaluation.failures import CAUSES
from torchdyn_plan.evaluation.results import ResultRow


def format_table(rows: Sequence[ResultRow]) -> str:
    """One aligned table of text: a line a row, rates in per cent, the paper's figure beside ours, ``–`` for none."""
    reach = rows[0].task == "reach"
    varying = [name for name in ("static", "velocity", "friction") if len({getattr(row, name) for row in rows}) > 1]
    others = [name for row in rows for name in row.failures]
    # Results of old know other causes.
    causes = [name for name in dict.fromkeys((*CAUSES, *others)) if name in others]
    if reach:
        causes = [name for name in causes if any(row.failures.get(name) for row in rows)]
    columns: list[tuple[str, Callable[[ResultRow], str]]] = [
        ("planner", lambda row: row.planner),
        *((name, lambda row, name=name: _plain(getattr(row, name))) for name in varying),
        ("success [95 %]", lambda row: _rate(row.success, row.success_ci)),
        ("paper", lambda row: _percent(row.paper_success)),
        ("of solvable [95 %]", lambda row: _rate(row.success_solvable, row.success_solvable_ci)),
        ("paper", lambda row: _percent(row.paper_success_solvable)),
        ("steps to reach" if reach else "steps to trap", lambda row: _number(row.steps_to_trap, 1 if reach else 0)),
        ("re-plans", lambda row: _number(row.replans, 1)),
        *((cause.replace("_", " "), lambda row, cause=cause: _percent(row.failures.get(cause))) for cause in causes),
    ]
    lines = [[name for name, _ in columns], *([cell(row) for _, cell in columns] for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(columns))]
    first, *others = (_align(line, widths) for line in lines)
    return "\n".join([_title(rows, varying), "", first, "─" * len(first), *others])


def _title(rows: Sequence[ResultRow], varying: Sequence[str]) -> str:
    """What all rows share, and how many of their episodes are solvable."""
    row = rows[0]
    shared = {"static": f"static planner {row.static}", "velocity": f"velocity {row.velocity:g} m/s",
              "friction": f"friction {row.friction:g}"}  # fmt: skip
    if row.task == "reach":
        shared |= {"velocity": f"velocity {row.velocity:g} m a step", "friction": f"motion {row.motion}"}
    parts = [row.task, *(text for name, text in shared.items() if name not in varying), _span(rows, "episodes", "d")]
    if not {"velocity", "friction"} & set(varying):
        parts.append(f"{100 * row.solvable:.0f} % solvable")
    return ", ".join(parts)


def _span(rows: Sequence[ResultRow], name: str, form: str) -> str:
    values = sorted({getattr(row, name) for row in rows})
    return f"{'–'.join(format(value, form) for value in {values[0]: 0, values[-1]: 0})} {name}"


def _align(cells: Sequence[str], widths: Sequence[int]) -> str:
    name, *numbers = cells
    return "  ".join([name.ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(numbers, widths[1:], strict=True))])


def _plain(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f} %"


def _rate(value: float | None, interval: tuple[float, float]) -> str:
    if value is None:
        return "–"
    low, high = (f"{100 * end:.0f}" for end in interval)
    return f"{100 * value:.0f} % [{low}–{high}]"
