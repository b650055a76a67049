"""Value learning from images: SR-SPR."""

from sb3_sample.srspr.algorithm import SRSPR

__all__ = ["SRSPR"]
