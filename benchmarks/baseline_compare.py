"""Compares recorded results with new ones: unchanged, better or worse, and why."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

Entries = dict[str, dict[str, Any]]
"""Results of a part by the name of a case, method, model or benchmark."""
ROUNDING = 80 * 2 * 2.0**-23
"""Bound on differences of losses, times the larger of 1 and the loss: scores are sums of terms of
about 1. A window is 80 steps in float32, each rounded half a unit (2⁻²⁴) in its pose and its twist,
before and now, and at worst all add up. The same code compiled at another level of XLA's
optimisation moved a loss of -0.21 by 1.3e-7, and its gradient's norm of 3.3 by 1.4e-6."""
SLOWER = 2.0
"""Factor of a time over its reference below which load and clock explain a difference."""
ERRORS = {
    "rmse_position": "position error (m)",
    "rmse_rotation": "rotation error (rad)",
    "rmse_linear_velocity": "linear velocity error (m/s)",
    "rmse_angular_velocity": "angular velocity error (rad/s)",
}
BANDS = {"coverage_0.5": 0.5, "coverage_0.9": 0.9}


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    part: str
    item: str
    what: str
    before: str
    now: str
    outcome: str
    remark: str = ""


def outcome(same: bool, better: bool = False) -> str:
    if same:
        return "unchanged"
    return "better" if better else "worse"


def same_three_digits(before: float | None, now: float | None) -> bool:
    """Whether they differ by half a unit of the third digit at most.

    Rounded to three digits, two numbers on both sides of a half would differ however near they are.
    """
    if before is None or now is None:
        return before is now
    if before == 0:
        return now == 0
    unit = 10.0 ** (math.floor(math.log10(abs(before))) - 2)
    return abs(now - before) <= unit / 2


def shown(value: float | None, unit: str = "") -> str:
    return "none" if value is None else f"{value:.4g} {'' if unit == '1' else unit}".strip()


def compare_losses(method: str, before: dict[str, Any], now: dict[str, Any]) -> Iterator[Row]:
    for name in ("loss", "gradient_norm"):
        was, found = before[name], now[name]
        bound = ROUNDING * max(1.0, abs(was))
        yield Row(
            "losses", method, name, f"{was:.8g}", f"{found:.8g}",
            outcome(abs(found - was) <= bound), f"by {found - was:.1g} of {bound:.1g}",
        )  # fmt: skip


def compare_diagnosis(case: str, before: dict[str, Any], now: dict[str, Any]) -> Iterator[Row]:
    """Names or a verdict that differ are better where all that was right is, and more."""
    right = [(before["right"][key], now["right"][key]) for key in before["right"]]
    better = all(b <= n for b, n in right) and any(b < n for b, n in right)
    was, found = ([(c["name"], c["where"]) for c in one["causes"]] for one in (before, now))
    told = [", ".join(f"{n} {w}".strip() for n, w in one) or "none" for one in (was, found)]
    verdicts = before["verdict"], now["verdict"]
    same = verdicts[0] == verdicts[1]
    yield Row("diagnosis", case, "names", told[0], told[1], outcome(was == found, better))
    yield Row("diagnosis", case, "verdict", *verdicts, outcome(same, better))
    if was != found:
        return
    for one, other in zip(before["causes"], now["causes"], strict=True):
        for name in dict.fromkeys([*one["parameters"], *other["parameters"]]):
            yield _parameter(
                case, one["name"], name, one["parameters"].get(name), other["parameters"].get(name)
            )


def _parameter(
    case: str, cause: str, name: str, one: dict[str, Any] | None, other: dict[str, Any] | None
) -> Row:
    what = f"{cause}.{name}"
    if one is None or other is None:
        before, now = ("none" if p is None else shown(p["value"], p["unit"]) for p in (one, other))
        return Row("diagnosis", case, what, before, now, "worse")
    was, found = one["value"], other["value"]
    remark, ends = "", one["interval95"]
    if None not in (was, found, *ends) and ends[1] > ends[0]:
        remark = f"by {(found - was) * 3.92 / (ends[1] - ends[0]):.1g} standard errors"
    same = one["unit"] == other["unit"] and same_three_digits(was, found)
    told = shown(was, one["unit"]), shown(found, other["unit"])
    return Row("diagnosis", case, what, *told, outcome(same), remark)


def compare_demo(model: str, before: dict[str, Any], now: dict[str, Any]) -> Iterator[Row]:
    """Digits as the demo prints them; the preset's don't change unless their evaluation does."""
    for name, was in before.items():
        form = ".0%" if name in BANDS else ".3f"
        told = f"{was:{form}}", f"{now[name]:{form}}"
        off = [abs(value - BANDS.get(name, 0.0)) for value in (was, now[name])]
        better = model == "learned" and off[1] < off[0]
        what = ERRORS.get(name, f"inside the {BANDS.get(name, 0):.0%} band")
        yield Row("demo", model, what, *told, outcome(told[0] == told[1], better))


def compare_mppi(
    bench: str, before: dict[str, Any], now: dict[str, Any], slower: float = SLOWER
) -> Iterator[Row]:
    factor = now["ratio"] / before["ratio"]
    told = [f"{one['ratio']:.3g} ({1e3 * one['seconds']:.3g} ms)" for one in (before, now)]
    same = 1 / slower <= factor <= slower
    what = "time over reference"
    yield Row(
        "mppi", bench, what, told[0], told[1], outcome(same, factor < 1), f"{factor:.2f} times"
    )


COMPARED: dict[str, Callable[..., Iterator[Row]]] = {
    "losses": compare_losses,
    "diagnosis": compare_diagnosis,
    "demo": compare_demo,
    "mppi": compare_mppi,
}


def compare(part: str, before: Entries, now: Entries, **options: float) -> Iterator[Row]:
    """Rows of all that was recorded; what is there now alone is not judged."""
    for item, entry in before.items():
        if item in now:
            yield from COMPARED[part](item, entry, now[item], **options)
        else:
            yield Row(part, item, "all", "recorded", "missing", "worse")


def table(rows: Sequence[Row]) -> str:
    """Columns of text, what is worse last."""
    order = ("unchanged", "better", "worse")
    head: tuple[str, ...] = ("part", "of", "what", "before", "now", "", "")
    lines: list[tuple[str, ...]] = [head]
    for row in sorted(rows, key=lambda row: order.index(row.outcome)):
        lines.append((row.part, row.item, row.what, row.before, row.now, row.outcome, row.remark))
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    text = ["  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) for line in lines]
    counts = ", ".join(f"{sum(r.outcome == o for r in rows)} {o}" for o in order)
    return "\n".join([*(line.rstrip() for line in text), counts])
