"""How exact the gradients are: against the plain unroll in float64, and of float32 against float64."""

import torch
from torch import Tensor

from bbr_layer import Adam, Annealed, Autograd, BBRLayer, Implicit, Replay
from benchmarks.layer_problems import clouds

NOTE = (
    "Relative errors of the gradient by both clouds (norms). Against `Autograd()` in float64 at n = m = 200, T = 30; "
    "of float32 against float64 at n = m = 1000, softBD, as given and with both clouds shifted by 1000 radii; of "
    "`Implicit()` by the points' weights at n = m = 100 after 900 steps."
)


def gradient(layer: BBRLayer, P: Tensor, Q: Tensor) -> Tensor:
    """Both clouds' gradients of a number that depends on the whole pose about the clouds' own place."""
    leaves = [x.clone().requires_grad_() for x in (P, Q)]
    motion = layer(*leaves).target_from_source
    moved = motion(leaves[1].detach().mean(0, keepdim=True)) - leaves[0].detach().mean(0, keepdim=True)
    found = torch.autograd.grad(motion.rotation[0, 1] + motion.rotation[2, 1] + moved.sum(), leaves)
    return torch.cat([x.double().flatten() for x in found])


def difference(found: Tensor, wanted: Tensor) -> str:
    """Relative error, of norms."""
    return f"{((found - wanted).norm() / wanted.norm()).item():.1e}"


def error_rows() -> list[str]:
    """All errors, a row each."""
    torch.set_num_threads(1)
    rows = ["| gradient | against | relative error |", "|---|---|---|"]
    for name in ("softBBS", "softBD", "N", "F"):
        pair = clouds(200, dtype=torch.float64)
        layers = [BBRLayer(name, inner=Adam(30, 0.05), backward=mode) for mode in (Replay(), Autograd())]
        found, wanted = (gradient(layer, *pair) for layer in layers)
        rows.append(f"| Replay, {name} | Autograd | {difference(found, wanted)} |")
        print(rows[-1], flush=True)
    for steps in (30, 100):
        layer = BBRLayer("softBD", inner=Adam(steps, 0.05))
        wanted = gradient(layer, *(x.double() for x in clouds(1000)))
        rows.append(f"| float32, T = {steps} | float64 | {difference(gradient(layer, *clouds(1000)), wanted)} |")
        shifted = clouds(1000, shift=1000.0)
        far = gradient(layer, *(x.double() for x in shifted))
        error = difference(gradient(layer, *shifted), far)
        rows.append(f"| float32, T = {steps}, shifted | float64, shifted | {error} |")
        print(*rows[-2:], sep="\n", flush=True)
    rows.append(f"| Implicit, by weights | Replay | {_implicit()} |")
    return rows


def _implicit() -> str:
    P, Q = clouds(100, dtype=torch.float64)
    answers = []
    for mode in (Implicit(on_unconverged="raise"), Replay()):
        layer = BBRLayer("softBD", inner=Adam(900, 0.05), temperature=Annealed(1.0, 1.0), backward=mode)
        weights = [torch.ones(100, dtype=torch.float64, requires_grad=True) for _ in range(2)]
        motion = layer(P, Q, P_weights=weights[0], Q_weights=weights[1]).target_from_source
        found = torch.autograd.grad(motion.rotation[0, 1] + motion.translation.sum(), weights)
        answers.append(torch.cat(found))
    return difference(*answers)
