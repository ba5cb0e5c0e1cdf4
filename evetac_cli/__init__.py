"""evetac: event-based touch, from a recording to a grasp."""

__version__ = "0.1.0"
