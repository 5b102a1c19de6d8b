"""``heliotrope track --law guo``: Guo's closed form, compared with the armature."""

from datetime import datetime
from typing import TYPE_CHECKING, Any

from heliotrope.cli._common import print_json, print_table

if TYPE_CHECKING:
    import numpy as np

    from heliotrope.mechanism.chain import Mechanism


def track_by_guo(
    name: str, mechanism: "Mechanism", sun: "np.ndarray", aim: "np.ndarray", moment: datetime,
    as_json: bool,
) -> None:  # fmt: skip
    """Print Guo's parameters and both branches of his formula."""
    document = _document(name, mechanism, sun, aim, moment)
    if as_json:
        print_json(document)
        return
    print(f"{name} at {moment.isoformat()} by Guo's formula, (26) and (9)")
    from heliotrope.mechanism.guo_names import NAMES

    shown = [
        f"{symbol} {float(document['guo'][key]):.4f} {unit}"
        for key, (symbol, _, unit) in NAMES.items()
    ]
    print(", ".join(shown))
    print(f"θ {document['theta_deg']:.4f}°, τ {1e3 * document['tau_mrad']:.3f} µrad")
    print_table(
        ["branch", "γ", "α", "counts", "to the armature's", ""],
        [
            [
                str(b["branch"]),
                f"{b['gamma_deg']:.4f}°",
                f"{b['alpha_deg']:.4f}°",
                "  ".join(f"{c:.1f}" for c in b["counts"]),
                f"{b['from_armature_mrad']:.3g} mrad",
                b["text"],
            ]
            for b in document["branches"]
        ],
    )


def _document(
    name: str, mechanism: "Mechanism", sun: "np.ndarray", aim: "np.ndarray", moment: datetime
) -> dict[str, Any]:
    import numpy as np

    from heliotrope.geometry import angle_between, wrap_signed
    from heliotrope.mechanism import guo, tracking
    from heliotrope.mechanism.guo_names import in_his_names, of_mechanism

    parameters, pivot = of_mechanism(mechanism)
    demanded = guo.mirror_normal(aim - pivot, sun, parameters.offset)
    solution = guo.track(aim - pivot, sun, parameters)
    armature = tracking.track(mechanism, sun, aim)
    branches = []
    for b in range(2):
        gamma, alpha = float(solution.gamma[b]), float(solution.alpha[b])
        # The nearest solution of the armature, including the rotation of the azimuth.
        apart = angle_between(guo.forward(alpha, gamma, parameters), armature.normal)
        over = np.abs(wrap_signed(armature.angles[:, 1] - alpha))
        other = int(np.argmin(over + apart))
        gamma = float(armature.angles[other, 0] + wrap_signed(gamma - armature.angles[other, 0]))
        alpha = float(armature.angles[other, 1] + wrap_signed(alpha - armature.angles[other, 1]))
        branches.append(
            {
                "branch": b,
                "gamma_deg": np.degrees(gamma),
                "alpha_deg": np.degrees(alpha),
                "angles_rad": [gamma, alpha],
                "counts": mechanism.drives.counts(np.array([gamma, alpha])),
                "from_armature_mrad": 1e3 * apart[other],
                "reachable": bool(solution.reachable),
                "residual_mrad": 1e3 * solution.residual,
                "text": tracking.TrackingStatus(int(armature.status[other])).text,
            }
        )
    return {
        "heliostat": name,
        "law": "guo",
        "time": moment,
        "sun_vector": sun,
        "aim": aim,
        "guo": in_his_names(parameters),
        "normal": solution.normal,
        "theta_deg": np.degrees(demanded.theta),
        "tau_mrad": 1e3 * demanded.tau,
        "branches": branches,
    }
