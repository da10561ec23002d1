"""The web page: what a person sees of the service, rendered by the service itself."""

from app.pages.routes import include, refusal

__all__ = ["include", "refusal"]
