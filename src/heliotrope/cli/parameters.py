"""``heliotrope parameters``: a heliostat's parameters in the models of Guo, Malan and ours."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from heliotrope.cli._common import parse_numbers, print_json, print_table
from heliotrope.errors import InputError, shown

if TYPE_CHECKING:
    from heliotrope.mechanism.guo import GuoParameters

Names = Literal["guo", "malan", "heliotrope"]


def parameters(
    values: Annotated[
        list[str],
        typer.Argument(
            help="Parameters as NAME=VALUE: angles in ° for Guo's parameters and in mrad for the "
            "others, lengths in m."
        ),
    ],
    source: Annotated[
        Names, typer.Option("--from", help="Convention of the parameter names.")
    ] = "guo",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Convert the error parameters of an azimuth-elevation heliostat between models."""
    machine = _machine(source, _parsed(values))
    document = {"guo": _guo(machine), "heliotrope": _heliotrope(machine)}
    try:
        document["malan"] = _malan(machine)
    except InputError as reason:
        document["malan"] = {"reason": str(reason)}
    if as_json:
        print_json(document)
        return
    rows = [
        [whose, name, f"{value + 0.0:.6g}"]
        for whose, converted in document.items()
        for name, value in converted.items()
        if isinstance(value, float)
    ]
    print_table(["convention", "parameter", "value"], rows)
    if "reason" in document["malan"]:
        print(f"cannot be expressed in Malan's parameters: {document['malan']['reason']}")


def _parsed(values: list[str]) -> dict[str, float]:
    parsed = {}
    for text in values:
        name, _, value = text.partition("=")
        refusal = f"{shown(text)}: write NAME=VALUE with a number, for example psi_t=1.854"
        (parsed[name.strip()],) = parse_numbers(value, refusal)
    return parsed


def _machine(source: Names, values: dict[str, float]) -> "GuoParameters":
    from heliotrope.mechanism import guo, guo_names

    if source == "guo":
        return guo_names.from_his_names(values)
    scaled = {n: v if n == "pivot_offset" else 1e-3 * v for n, v in values.items()}
    return guo.from_malan(scaled) if source == "malan" else guo.from_heliotrope(scaled)


def _guo(machine: "GuoParameters") -> dict[str, Any]:
    from heliotrope.mechanism.guo_names import NAMES, in_his_names

    return {
        f"{name}_deg" if NAMES[name][2] == "°" else f"{name}_m": float(value)
        for name, value in in_his_names(machine).items()
    }


def _heliotrope(machine: "GuoParameters") -> dict[str, Any]:
    from heliotrope.mechanism.guo import to_heliotrope

    return {
        **{
            f"{name}_mrad": 1e3 * float(value)
            for name, value in to_heliotrope(machine).items()
            if name != "pivot_offset"
        },
        "pivot_offset_m": float(machine.offset),
    }


def _malan(machine: "GuoParameters") -> dict[str, Any]:
    from heliotrope.mechanism.guo import to_malan

    return {f"{name}_mrad": 1e3 * float(value) for name, value in to_malan(machine).items()}
