"""Best Buddies Registration (Drory, Shomer, Avidan, Giryes, ACCV 2020) as a differentiable layer."""

import logging
from contextlib import nullcontext
from functools import partial

import torch
from torch import Tensor, nn

from bbr_layer.backward import Backward, Detached, Replay
from bbr_layer.door import batch_shape, checked_pair, checked_start
from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.adam import Adam
from bbr_layer.normals import estimate_normals, point_spacing
from bbr_layer.pair import CloudPair, Frame, into_frame
from bbr_layer.registration import Registration, judge, matched_information
from bbr_layer.stage import Stage, default_stages, named_stage, paper_stage
from bbr_layer.start import better_start
from bbr_layer.temperature import Temperature

LOGGER = logging.getLogger("bbr_layer")


class BBRLayer(nn.Module):
    """Registers Q onto P by lowering a best-buddies loss, and stays differentiable in everything it was given.

    Parameters
    ----------
    stages: ``Stage`` objects, each starting where the last one ended; or one of the paper's names ``"softBBS"``,
        ``"softBD"``, ``"N"``, ``"F"`` for a single scale-free stage. None: the measured default, softBBS then F.
    backward: how gradients reach the inputs: ``Replay()`` (default), ``Truncated(last_steps)``, ``Autograd()`` or
        ``Detached()``.
    inner, temperature: settings of the one stage that is given by name.

    Raises
    ------
    ValueError: settings that cannot work, where they are given.

    >>> P = torch.rand(60, 3, generator=torch.Generator().manual_seed(0))
    >>> turn = RigidMotion.from_rotvec(torch.tensor([0.0, 0.0, 0.3]), torch.tensor([0.1, 0.0, 0.0]))
    >>> result = BBRLayer()(P, turn.inverse()(P))
    >>> bool(torch.allclose(result.target_from_source.matrix, turn.matrix.double(), atol=1e-2))
    True
    """

    def __init__(
        self,
        *stages: Stage | str,
        backward: Backward | None = None,
        inner: Adam | None = None,
        temperature: Temperature | None = None,
    ):
        super().__init__()
        names = [stage for stage in stages if isinstance(stage, str)]
        given = [stage for stage in stages if isinstance(stage, Stage)]
        named = len(names) == len(stages) == 1
        if (inner is not None or temperature is not None) and not named:
            raise ValueError("inner and temperature belong to one stage given by name: BBRLayer('softBD', inner=...)")
        if not named and len(given) != len(stages):
            raise ValueError("stages must all be Stage objects, or one of the paper's names alone: try BBRLayer('F')")
        chosen = [named_stage(names[0], inner, temperature)] if named else given or default_stages()
        self.stages = nn.ModuleList(chosen)
        self.backward_mode = Replay() if backward is None else backward
        self.scaled = all(stage.chart.scaled for stage in chosen)

    @property
    def sequence(self) -> list[Stage]:
        """The stages in order."""
        return [stage for stage in self.stages if isinstance(stage, Stage)]

    @staticmethod
    def paper(name: str, backward: Backward | None = None) -> "BBRLayer":
        """The paper's ``"softBBS"``, ``"softBD"``, ``"N"`` or ``"F"`` with the constants of the authors' code.

        For reproduction: rates are in metres of a 15 cm object, and the start is the identity.
        """
        return BBRLayer(paper_stage(name), backward=backward)

    def forward(
        self,
        P: Tensor,
        Q: Tensor,
        *,
        P_normals: Tensor | None = None,
        Q_normals: Tensor | None = None,
        P_features: Tensor | None = None,
        Q_features: Tensor | None = None,
        P_weights: Tensor | None = None,
        Q_weights: Tensor | None = None,
        P_mask: Tensor | None = None,
        Q_mask: Tensor | None = None,
        start: RigidMotion | None = None,
    ) -> Registration:
        """Find ``target_from_source``.

        Parameters
        ----------
        P, Q: ``(*batch, n, d)`` target and ``(*batch, m, d)`` source, d = 2 or 3, any unit.
        P_normals, Q_normals: like P and Q; estimated where a loss needs them and they are not given.
        P_features, Q_features: ``(*batch, n, c)`` and ``(*batch, m, c)``, matched beside the coordinates.
        P_weights, Q_weights: ``(*batch, n)`` and ``(*batch, m)``, not negative.
        P_mask, Q_mask: the same shapes, boolean, True where a point is real.
        start: where to begin. Default: the better of leaving Q in place and laying centroid on centroid.

        Raises
        ------
        ValueError: one sentence on what is wrong with which argument.
        """
        given = CloudPair(P, Q, P_normals, Q_normals, P_features, Q_features, P_weights, Q_weights, P_mask, Q_mask)
        return self._entered(given, start)

    def _entered(self, given: CloudPair, start: RigidMotion | None) -> Registration:
        """Check what came, and register it under the caller's mode of autograd, whichever that is."""
        keep_graph = torch.is_grad_enabled()
        outside_inference = torch.inference_mode(False) if torch.is_inference_mode_enabled() else nullcontext()
        with outside_inference, torch.autocast(_device_type(given.P), enabled=False):
            flat = checked_pair(given)
            begun = checked_start(start, flat, batch_shape(given.P))
            differentiable = keep_graph and self._wants_gradient(flat, begun)
            with torch.set_grad_enabled(differentiable):
                result = self._register(flat if differentiable else flat.detach(), begun, differentiable)
        return result.reshape(batch_shape(given.P))

    def _register(self, given: CloudPair, start: RigidMotion | None, differentiable: bool) -> Registration:
        frame, pair = into_frame(given, self.scaled)
        pair = self._with_normals(self._with_spacing(pair))
        motion = self._start(pair, frame, start)
        mode = self.backward_mode if differentiable else Detached()
        stages = self.sequence
        steps, done = sum(stage.inner.steps for stage in stages), 0
        for stage in stages:
            attached = partial(_attached, mode, done, steps)
            ended = stage(pair, frame, motion, attached, closed_form=mode.closed_form)
            motion, done = ended.motion, done + stage.inner.steps
        buddies, information = matched_information(pair, frame.enter(motion), frame)
        status = judge(motion, buddies, information, frame, ended.settled)
        iterations = torch.full_like(buddies, steps)
        return Registration(
            motion,
            ended.loss,
            ended.temperature,
            ended.gradient_norm,
            iterations,
            buddies,
            information,
            status,
        )

    def _start(self, pair: CloudPair, frame: Frame, start: RigidMotion | None) -> RigidMotion:
        if start is not None:
            return start
        if not self.scaled:
            return RigidMotion.identity(pair.P.shape[-1], pair.P.shape[:1], device=pair.P.device)
        return better_start(pair, frame)

    def _with_spacing(self, pair: CloudPair) -> CloudPair:
        spacing = (point_spacing(pair.P, pair.P_mask) + point_spacing(pair.Q, pair.Q_mask)) / 2
        return pair._replace(spacing=torch.where(spacing > 0, spacing, 1.0))

    def _with_normals(self, pair: CloudPair) -> CloudPair:
        if not any(stage.loss.needs_normals for stage in self.sequence):
            return pair
        if pair.P_normals is None or pair.Q_normals is None:
            LOGGER.info("normals were not given and are estimated from the clouds themselves")
        if pair.P_normals is None:
            pair = pair._replace(P_normals=estimate_normals(pair.P, mask=pair.P_mask))
        if pair.Q_normals is None:
            pair = pair._replace(Q_normals=estimate_normals(pair.Q, mask=pair.Q_mask))
        return pair

    def _wants_gradient(self, pair: CloudPair, start: RigidMotion | None) -> bool:
        settings = [x for m in self.modules() for x in vars(m).values() if isinstance(x, Tensor)]
        fields = [x for x in (*pair, *(start or ())) if x is not None]
        return any(x.requires_grad for x in (*fields, *settings, *self.parameters()))

    def __repr__(self) -> str:
        stages = ", ".join(map(repr, self.stages))
        return f"BBRLayer({stages}, backward={self.backward_mode!r})"


def _attached(mode: Backward, done: int, steps: int, step: int) -> bool:
    """Whether ``step`` of a stage that begins after ``done`` of all ``steps`` is kept differentiable."""
    return mode.attached(done + step, steps)


def _device_type(points: Tensor) -> str:
    """Where autocast is turned off; what is no tensor is refused a little later, in words."""
    return points.device.type if isinstance(points, Tensor) and points.device.type != "meta" else "cpu"
