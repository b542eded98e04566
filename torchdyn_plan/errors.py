"""The one family of errors: each message names the offender and what was expected."""


class TorchdynPlanError(Exception):
    """Base of every error that this package raises on purpose."""


class InputError(TorchdynPlanError, ValueError):
    """A caller's argument is wrong: its shape, value, device, name or type."""


class WeightsError(TorchdynPlanError, ValueError):
    """A weights file is missing, truncated, or belongs to another network."""


class OutputError(TorchdynPlanError, OSError):
    """A result cannot be written where it was asked for."""


class TrainingError(TorchdynPlanError, RuntimeError):
    """A training run cannot go on; its last good checkpoint is kept."""


class CompileError(TorchdynPlanError, RuntimeError):
    """Something cannot be compiled on this machine."""
