"""The twin: a surface with materials, a light and a response, in memory and on disk."""

from endotwin.twin.registration import Registration
from endotwin.twin.twin import Light, Materials, Response, Source, Twin, as_twin

__all__ = ["Light", "Materials", "Registration", "Response", "Source", "Twin", "as_twin"]
