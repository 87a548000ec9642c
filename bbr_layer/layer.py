"""Best Buddies Registration (Drory, Shomer, Avidan, Giryes, ACCV 2020) as a differentiable layer."""

from contextlib import nullcontext

import torch
from torch import Tensor, nn

from bbr_layer.backward import Backward, Detached, Implicit, Replay, speak_up
from bbr_layer.descent import descended, inner_steps
from bbr_layer.door import batch_shape, checked_pair, checked_start, own_precision
from bbr_layer.geometry import RigidMotion
from bbr_layer.named_stages import default_stages, fast_stages, named_stage, paper_stage
from bbr_layer.pair import CloudPair
from bbr_layer.preparation import begun_at, prepared
from bbr_layer.registration import Registration, judged
from bbr_layer.stage import Inner, Stage
from bbr_layer.starts import best_start
from bbr_layer.temperature import Temperature
from bbr_layer.transforms import Settled, is_transformed, places_of, registered, settings_of

# Measured (benchmarks/starts.md, planar.md): none of 180 registrations turned by 30 to 90 degrees fails.
ROBUST_STARTS = 7


class BBRLayer(nn.Module):
    """Registers Q onto P by lowering a best-buddies loss, and stays differentiable in everything it was given.

    Parameters
    ----------
    stages: ``Stage`` objects, each starting where the last one ended; or one of the paper's names ``"softBBS"``,
        ``"softBD"``, ``"N"``, ``"F"`` for a single scale-free stage. None: the measured default, softBBS then F.
    starts: how many starting rotations are tried as one batch, on as few points as the second stage sees; the one that
        ends with most buddies on each other's planes is kept (without normals: lowest softBBS). In 3D, without
        features, an F of finite reach ends from about that answer once more (benchmarks/around.md). The gradient is
        that of the last run; the choice has none. None: 1, or in the plane by default 7, if no start is given
        (benchmarks/planar.md); ``BBRLayer.robust()`` tries 7 (benchmarks/starts.md).
    backward: how gradients reach the inputs: ``Replay()`` (default, exact), ``Truncated(last_steps)``,
        ``Implicit()``, ``Autograd()`` (second derivatives) or ``Detached()``.
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
        starts: int | None = None,
        inner: Inner | None = None,
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
        for first in filter(None, (next((x for x in chosen if x.dimension in (None, d)), None) for d in (2, 3))):
            if first.above:
                raise ValueError(f"the first stage has above={first.above}; smaller clouds would be left with none: 0")
        self.stages = nn.ModuleList(chosen)
        if starts is not None and (not isinstance(starts, int) or starts < 1):
            raise ValueError(f"starts is {starts}; it must be a whole number of at least 1: try 7")
        if backward is not None and not isinstance(backward, Backward):
            raise ValueError(f"backward is {backward!r}; it must be one of the modes, as an object: try Replay()")
        self.starts = starts
        self.backward_mode = Replay() if backward is None else backward
        self.scaled = all(stage.chart.scaled for stage in chosen)

    @property
    def sequence(self) -> list[Stage]:
        """The stages in order."""
        return [stage for stage in self.stages if isinstance(stage, Stage)]

    @staticmethod
    def fast(backward: Backward | None = None) -> "BBRLayer":
        """Soft buddies of few points, then a few steps of Gauss-Newton: six tenths of the default's time.

        As accurate, but more of the turns by 60 degrees fail (benchmarks/solvers.md).
        """
        return BBRLayer(*fast_stages(), backward=backward)

    @staticmethod
    def robust(backward: Backward | None = None) -> "BBRLayer":
        """The default stages from 7 starts, 40 degrees to both sides about every axis (in 2D: up to 120 degrees).

        For pairs that may lie far apart.
        """
        return BBRLayer(backward=backward, starts=ROBUST_STARTS)

    @staticmethod
    def paper(name: str, backward: Backward | None = None) -> "BBRLayer":
        """The paper's ``"softBBS"``, ``"softBD"``, ``"N"`` or ``"F"`` with the constants of the authors' code.

        For reproduction: rates are in metres of a 15 cm object, and the start is the identity. A gradient through
        all its steps may overflow, with N it does: give ``backward=Truncated(20)``.
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
        P_features, Q_features: ``(*batch, n, c)`` and ``(*batch, m, c)``, matched by soft losses beside coordinates.
        P_weights, Q_weights: ``(*batch, n)`` and ``(*batch, m)``, not negative.
        P_mask, Q_mask: the same shapes, boolean, True where a point is real.
        start: where to begin. Default: the better of leaving Q in place and laying centroid on centroid.

        Raises
        ------
        ValueError: one sentence on what is wrong with which argument.
        """
        given = CloudPair(P, Q, P_normals, Q_normals, P_features, Q_features, P_weights, Q_weights, P_mask, Q_mask)
        if torch.compiler.is_compiling():
            # Trees and compiled sweeps are nothing to trace. Not as a decorator, which would load the compiler into
            # every program that imports the layer.
            return torch.compiler.disable(self._called)(given, start)
        return self._called(given, start)

    def _called(self, given: CloudPair, start: RigidMotion | None) -> Registration:
        how = Settled(self._entered, places_of(self))
        return registered(how, given, start) if is_transformed(given, start, how) else self._entered(given, start)

    def _entered(self, given: CloudPair, start: RigidMotion | None) -> Registration:
        """Check what came, and register it under the caller's mode of autograd, whichever that is."""
        keep_graph = torch.is_grad_enabled()
        outside_inference = torch.inference_mode(False) if torch.is_inference_mode_enabled() else nullcontext()
        with outside_inference, own_precision(given) as widened:
            flat = checked_pair(widened)
            begun = checked_start(start, flat, batch_shape(given.P))
            differentiable = keep_graph and self._wants_gradient(flat, begun)
            with torch.set_grad_enabled(differentiable):
                result = self._register(flat if differentiable else flat.detach(), begun, differentiable)
        return result.reshape(batch_shape(given.P))

    def _register(self, given: CloudPair, start: RigidMotion | None, differentiable: bool) -> Registration:
        needs_normals = any(stage.loss.needs_normals for stage in self.sequence)
        frame, pair = prepared(given, needs_normals, self.scaled)
        motion = begun_at(start, pair, frame, self.scaled)
        stages = [stage for stage in self.sequence if stage.wanted(pair)]
        if not stages:
            most = int(torch.maximum(*pair.real_counts()).max())
            shown = f"{pair.P.shape[-1]}D clouds of up to {most} points"
            raise ValueError(f"no stage of the layer is for {shown}: look at its dimension, above and upto")
        starts = self.starts or (ROBUST_STARTS if start is None and stages[0].dimension == 2 else 1)
        if starts > 1:
            motion, stages, tried, whole = best_start(starts, stages, (pair, frame), motion)
            if whole and not differentiable:
                return judged(pair, frame, tried, inner_steps(stages))
        mode = self.backward_mode if differentiable else Detached()
        ended = descended(stages, (pair, frame), motion, mode)
        if isinstance(mode, Implicit):
            ended, doubt = stages[-1].attach(pair, frame, ended, mode.damping)
            if doubt and mode.on_unconverged == "replay":
                ended = descended(stages, (pair, frame), motion, Replay())
            elif doubt:
                speak_up(mode, doubt)
        return judged(pair, frame, ended, inner_steps(stages))

    def _wants_gradient(self, pair: CloudPair, start: RigidMotion | None) -> bool:
        given = *pair, *(start or ()), *settings_of(places_of(self))
        return any(x is not None and x.requires_grad for x in given)

    def __repr__(self) -> str:
        settings = [*map(repr, self.stages), f"backward={self.backward_mode!r}"]
        settings += [] if self.starts in (None, 1) else [f"starts={self.starts}"]
        many = len(self.stages) > 1
        return "BBRLayer(\n  " + ",\n  ".join(settings) + "\n)" if many else f"BBRLayer({', '.join(settings)})"
