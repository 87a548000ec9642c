"""The losses in closed form: value, gradient and directional derivative, by sweeps over pairs of points."""
