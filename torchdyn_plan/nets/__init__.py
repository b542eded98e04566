"""Models: forecasts with their uncertainty, arrival times of a robot, and policies that move it."""

from typing import TYPE_CHECKING

from torchdyn_plan.lazy import lazy_names

if TYPE_CHECKING:
    from torchdyn_plan.nets.analytic import Ballistic, Billiard, ConstantVelocity
    from torchdyn_plan.nets.analytic_arrival import AnalyticArrival, GoalJoints, SolvedJoints
    from torchdyn_plan.nets.arrival import ArrivalModel, ArrivalQuery, FunctionArrival
    from torchdyn_plan.nets.by_noise import ForecastByNoise
    from torchdyn_plan.nets.capture import CaptureConfig, CaptureModel, CaptureNetwork, FunctionCapture
    from torchdyn_plan.nets.distributions import ESTIMATORS, Arrival, Spread
    from torchdyn_plan.nets.eta import ETAConfig, ETANetwork
    from torchdyn_plan.nets.forecast import DescribedForecast, Forecast, ForecastModel, FunctionForecast
    from torchdyn_plan.nets.forecaster import Forecaster, ForecasterConfig
    from torchdyn_plan.nets.point_arrival import PointArrival
    from torchdyn_plan.nets.policy import Actor, Critic, PolicyConfig
    from torchdyn_plan.nets.spread import SpreadConfig, SpreadForecaster, SpreadNetwork

__all__ = [
    "ESTIMATORS",
    "Actor",
    "AnalyticArrival",
    "Arrival",
    "ArrivalModel",
    "ArrivalQuery",
    "Ballistic",
    "Billiard",
    "CaptureConfig",
    "CaptureModel",
    "CaptureNetwork",
    "ConstantVelocity",
    "Critic",
    "DescribedForecast",
    "ETAConfig",
    "ETANetwork",
    "Forecast",
    "ForecastByNoise",
    "ForecastModel",
    "Forecaster",
    "ForecasterConfig",
    "FunctionArrival",
    "FunctionCapture",
    "FunctionForecast",
    "GoalJoints",
    "PointArrival",
    "PolicyConfig",
    "SolvedJoints",
    "Spread",
    "SpreadConfig",
    "SpreadForecaster",
    "SpreadNetwork",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "analytic": ("Ballistic", "Billiard", "ConstantVelocity"),
        "analytic_arrival": ("AnalyticArrival", "GoalJoints", "SolvedJoints"),
        "arrival": ("ArrivalModel", "ArrivalQuery", "FunctionArrival"),
        "by_noise": ("ForecastByNoise",),
        "capture": ("CaptureConfig", "CaptureModel", "CaptureNetwork", "FunctionCapture"),
        "distributions": ("ESTIMATORS", "Arrival", "Spread"),
        "eta": ("ETAConfig", "ETANetwork"),
        "forecast": ("DescribedForecast", "Forecast", "ForecastModel", "FunctionForecast"),
        "forecaster": ("Forecaster", "ForecasterConfig"),
        "point_arrival": ("PointArrival",),
        "policy": ("Actor", "Critic", "PolicyConfig"),
        "spread": ("SpreadConfig", "SpreadForecaster", "SpreadNetwork"),
    },
)
