"""Reading and writing of fitted models, and their conversion to MJCF."""

from .model import Model, read_model, write_model

__all__ = ["Model", "read_model", "write_model"]
