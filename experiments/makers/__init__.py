"""Scripts that made the demo clip, the figures and the weights that come with the package."""
