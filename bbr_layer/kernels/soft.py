"""The kernel of the soft losses: the fastest sweeps that can do what is asked."""

from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.kernels.choice import sweeps_for
from bbr_layer.kernels.scene import Direction, Scene, SoftTerms


class SoftKernel:
    """softBBS, softBD or N, by their ``terms``."""

    def __init__(self, terms: SoftTerms):
        self.terms = terms

    def gradient(self, scene: Scene, motion: RigidMotion) -> tuple[Tensor, Scene]:
        """Loss ``(batch,)`` and gradient by everything in the scene; see ``Kernel``."""
        return sweeps_for(self.terms, scene).gradient(self.terms, scene)

    def directional(self, scene: Scene, motion: RigidMotion, direction: Direction) -> tuple[Scene, Scene]:
        """The gradient, and its derivative along ``direction``."""
        return sweeps_for(self.terms, scene).directional(self.terms, scene, direction)
