"""Forces that MJCF has no element for."""
