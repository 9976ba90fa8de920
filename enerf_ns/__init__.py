"""E-NeRF for Nerfstudio: radiance fields from event cameras."""

__version__ = "0.1.0"
