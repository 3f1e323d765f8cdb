"""The paper's figures 3 and 5 as curves over the frames."""

from fitting.errors import NORM_FLOOR, SH, by_part, sum_errors
from fitting.motion import MIXED
from fitting.study.ground import Ground, cosine_floor, diffuse_operator
from fitting.study.lobes import LOBE_COUNTS, refined_label


def series(name: str, target: str, norm: str, predicted: SH, truth: SH, part, *, floor: float) -> dict:
    """One curve of a figure, over the frames that are not mixed."""
    real = part != MIXED
    sums = sum_errors(predicted[real], truth[real], floor=floor)
    return {"name": name, "target": target, "norm": norm, "curve": sums.frame_curve(), **by_part(sums, part[real])}


def figure3(ground: Ground, plain: SH) -> list[dict]:
    """Plain fit, cosine-weighted fit, and the plain fit convolved analytically (the paper's figure 3).

    The convolved one stands against both truths: it wins or loses by the choice.
    """
    cosine_target = "cosine-weighted visibility from the bits, order 4"
    truncated = "M^1/pi of order-4 visibility"
    norm, cosine_norm = f"max(|v|, {NORM_FLOOR})", f"max(|t|, {cosine_floor():.3f})"
    weighted, convolved = ground.linear.predict(ground.cosine), plain @ diffuse_operator()
    part, low = ground.data.part, cosine_floor()
    return [
        series("plain fit", "order-4 visibility", norm, plain, ground.sh, part, floor=NORM_FLOOR),
        series("cosine-weighted fit", cosine_target, cosine_norm, weighted, ground.cosine, part, floor=low),
        series("plain fit, convolved", cosine_target, cosine_norm, convolved, ground.cosine, part, floor=low),
        series(
            "plain fit, convolved", truncated, cosine_norm, convolved, ground.sh @ diffuse_operator(), part, floor=low
        ),
    ]


def figure5(ground: Ground, refined: dict[tuple[int, bool], SH]) -> list[dict]:
    """One lobe against two and three (the paper's figure 5), jointly refined, without and with the constant offset."""
    norm, part = f"max(|v|, {NORM_FLOOR})", ground.data.part
    return [
        series(
            refined_label(c, offset), "order-4 visibility", norm, refined[c, offset], ground.sh, part, floor=NORM_FLOOR
        )
        for offset in (False, True)
        for c in LOBE_COUNTS
    ]
