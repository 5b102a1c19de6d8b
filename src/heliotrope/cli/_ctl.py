"""``heliotrope ctl``: view and command a running plant, with or without its console."""

import os
import re
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

import typer

from heliotrope.cli._common import (
    parse_duration,
    parse_numbers,
    parse_point,
    parse_time,
    print_json,
    print_table,
)
from heliotrope.errors import InputError, UnknownNameError

if TYPE_CHECKING:
    from heliotrope.cli._at_plant import AtPlant
    from heliotrope.console.client import Client

app = typer.Typer(help="Monitor and command a running plant.", no_args_is_help=True)

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Whom = Annotated[list[str] | None, typer.Argument(help="Heliostats.", show_default=False)]
All = Annotated[bool, typer.Option("--all", help="The whole field.")]
LockedTargets = Annotated[
    list[str] | None, typer.Option("--target", help="Target; may be repeated.", show_default=False)
]
LockedReceivers = Annotated[
    list[str] | None,
    typer.Option("--receiver", help="Receiver; may be repeated.", show_default=False),
]
LockedTower = Annotated[bool, typer.Option("--tower", help="The tower: all heliostats.")]
#: Status codes: name, password or code is wrong; a second-factor code is required.
_REFUSED, _NEEDS_CODE = 401, 428
Wait = Annotated[
    float,
    typer.Option(
        "--wait", min=0, max=86_400, help="Maximum time to wait for completion, s; 0: do not wait."
    ),
]


@app.callback()
def _where(
    context: typer.Context,
    url: Annotated[
        str, typer.Option(envvar="HELIOTROPE_URL", help="Address of the console.")
    ] = "http://127.0.0.1:8080/",
    token_file: Annotated[
        Path | None,
        typer.Option(
            help="File with the API token; default: HELIOTROPE_TOKEN.", show_default=False
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            envvar="HELIOTROPE_PLANT",
            help="Data folder of a plant on this computer: connect to the plant itself, "
            "without its console, as the plant's user or root; EMERGENCY, DEFOCUS, "
            "STOW and views need no token.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """View and command a running plant."""
    context.obj = (url, token_file, data)


def _sign_in_client(context: typer.Context) -> "Client":
    """Return a client without a token, because only the console accepts passwords."""
    from heliotrope.console.client import Client

    return Client("", context.obj[0])


def _sign_in(client: "Client", name: str, password: str) -> None:
    """Sign in, and ask for a code if the account has a second factor."""
    from heliotrope.console.stream import RemoteError

    try:
        client.sign_in(name, password)
    except RemoteError as error:
        if error.status == _REFUSED:
            raise RemoteError(
                f"{error}; an account created with the one-time link has no password until you "
                "set one on the console's /account page",
                error.status,
            ) from None
        if error.status != _NEEDS_CODE:
            raise
        client.sign_in(name, password, typer.prompt("Code of your second factor"))


def _client(context: typer.Context) -> "Client | AtPlant":
    url, file, data = context.obj
    secret = os.environ.get("HELIOTROPE_TOKEN", "")
    if file is not None:
        try:
            secret = file.read_text(encoding="utf-8").strip()
        except OSError as error:
            raise InputError(f"token file {file}: {error.strerror}") from None
    if data is not None:
        from heliotrope.cli._at_plant import AtPlant

        return AtPlant(secret, data)
    if not secret:
        raise InputError(
            "ctl: no token; create one with `heliotrope ctl token LABEL`, then set "
            "HELIOTROPE_TOKEN or use --token-file; on the plant's computer EMERGENCY, DEFOCUS and "
            "STOW need no token: use --data with its data folder"
        )
    from heliotrope.console.client import Client

    return Client(secret, url)


@app.command()
def token(
    context: typer.Context,
    label: Annotated[str, typer.Argument(help="Label that says what the token is for.")],
    name: Annotated[str, typer.Option(help="Name of your account.")] = "engineer",
    role: Annotated[str, typer.Option(help="viewer, operator or engineer.")] = "operator",
    days: Annotated[
        float,
        typer.Option(
            min=0.001,
            max=365,
            help="Days for which the token is valid: at most 365 for a viewer, 90 for a higher "
            "role.",
        ),
    ] = 30.0,
) -> None:
    """Create an API token, which is printed once; this asks for your password."""
    password = typer.prompt("Password", hide_input=True, err=True)
    with _sign_in_client(context) as client:
        _sign_in(client, name, password)
        made = client.ask(
            "POST",
            "tokens",
            {"label": label, "role": role, "days": days, "own_password": password},
        )
        client.ask("DELETE", "session")
    print(made["secret"])


@app.command()
def password(
    context: typer.Context,
    name: Annotated[str, typer.Option(help="Name of your account.")] = "engineer",
) -> None:
    """Change your own password, which ends your sessions and tokens."""
    old = typer.prompt("Password", hide_input=True)
    new = typer.prompt("New password", hide_input=True, confirmation_prompt=True)
    with _sign_in_client(context) as client:
        _sign_in(client, name, old)
        client.change_password(old, new)
    print(f"password of {name} changed")


@app.command()
def factor(
    context: typer.Context,
    name: Annotated[str, typer.Option(help="Name of your account.")] = "engineer",
    remove: Annotated[bool, typer.Option("--remove", help="Remove your second factor.")] = False,
    reset: Annotated[
        str,
        typer.Option(
            help="Remove the second factor of another account; requires an "
            "engineer with a second factor."
        ),
    ] = "",
) -> None:
    """Set up the second factor of your account: authenticator codes."""
    own = typer.prompt("Password", hide_input=True)
    with _sign_in_client(context) as client:
        _sign_in(client, name, own)
        if remove or reset:
            code = typer.prompt("Next code of your second factor")
            path = f"{_account(reset)}/factor" if reset else "session/factor"
            client.ask("DELETE", path, {"own_password": own, "own_code": code})
            print(f"{reset or name} has no second factor")
        else:
            _set_up_factor(client, own)
        client.ask("DELETE", "session")


def _set_up_factor(client: "Client", own: str) -> None:
    import segno

    made = client.ask("POST", "session/factor", {"own_password": own})
    segno.make(made["uri"]).terminal(compact=True)
    print(f"Scan it with an authenticator app, or enter the secret there: {made['secret']}")
    code = typer.prompt("Code shown by the app")
    answer = client.ask("PUT", "session/factor", {"code": code})
    print("The second factor is enabled. Recovery codes, shown only once; each can be used once:")
    print("\n".join(answer["codes"]))


def _account(name: str) -> str:
    """Return the path of an account, whatever characters its name contains."""
    return f"accounts/{quote(name, safe='')}"


@app.command()
def account(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the account.")],
    role: Annotated[str, typer.Option(help="viewer, operator or engineer.")] = "viewer",
    by: Annotated[
        str, typer.Option(help="Your account, which must have the engineer role.")
    ] = "engineer",
    disable: Annotated[bool, typer.Option("--disable", help="Disable the account.")] = False,
    reset: Annotated[
        bool, typer.Option("--reset", help="Create a new password and print it once.")
    ] = False,
) -> None:
    """Create or disable an account, or set a password that must be changed at first use."""
    if disable and reset:
        raise InputError("ctl: use --disable or --reset, not both")
    own = typer.prompt("Your password", hide_input=True)
    with _sign_in_client(context) as client:
        _sign_in(client, by, own)
        again = {"own_password": own}
        if reset:
            made = client.ask("POST", f"{_account(name)}/password", again)
            print(
                f"new password for {name}, shown only once; change it after signing in: "
                f"{made['password']}"
            )
        elif disable:
            client.ask("PATCH", _account(name), {"disabled": True, **again})
        else:
            password = typer.prompt(
                f"Password of {name}", hide_input=True, confirmation_prompt=True
            )
            new = {"name": name, "role": role, "password": password, **again}
            client.ask("POST", "accounts", new)
        client.ask("DELETE", "session")
    if not reset:
        print(f"account {name}: {'disabled' if disable else role}")


@app.command()
def status(context: typer.Context, as_json: Json = False) -> None:
    """Print a summary of the plant's state."""
    from heliotrope.values import amount

    with _client(context) as client:
        answer = client.get("summary")
        order = client.get("emergency") if answer["emergency"] else {}
    if as_json:
        print_json(answer)
        return
    print(f"{answer['name']}, {answer['at']}")
    print_table(("state", "heliostats"), [(k, str(v)) for k, v in answer["states"].items()])
    print(f"{answer['clusters_alive']} of {amount(answer['clusters'], 'cluster')} reporting")
    for name, value in answer["readings"].items():
        print(f"{name}: {'no reading' if value is None else f'{value:.3g}'}")
    print(f"{amount(answer['alarms'], 'alarm')} active or unacknowledged")
    print(f"{answer['holder'] or 'nobody'} has the command authority")
    if answer["emergency"]:
        print(f"EMERGENCY ({order['act']}): {order['text']}")
        _print_causes(order)
    if answer["resume"]:
        print(f"automatic control waits for Resume: {answer['resume']}")


@app.command()
def aims(context: typer.Context, as_json: Json = False) -> None:
    """Print how aims are chosen, and how close the flux is to its limit."""
    with _client(context) as client:
        answer = client.get("aims")
    if as_json:
        print_json(answer)
        return
    if answer["strategy"] != "limit":
        print("aims from the plant file; no flux limit is set")
        return
    _print_aims(answer)


def _print_aims(answer: dict[str, Any]) -> None:
    from heliotrope.values import amount

    if answer["problem"]:
        print(answer["problem"])
    if answer["idle"]:
        print(f"nothing is moved: {answer['idle']}")
    print(f"source of the aims: {answer['source'] or 'none yet'}")
    if answer["peak"] is not None:
        share = answer["reserve"]
        rest = f"{100 * share:.1f} % left" if share >= 0.0 else f"{-100 * share:.1f} % ABOVE it"
        print(
            f"limit {1e-3 * answer['limit']:.4g} kW/m², flux including errors up to "
            f"{1e-3 * answer['peak']:.4g} kW/m², {rest}, "
            f"{amount(answer['binding'], 'cell')} at the limit, {answer['at']:.0f} s ago"
        )
        best = answer["planned"]
        print(
            f"{1e-3 * answer['power']:.5g} kW"
            + ("" if best is None else f" of {1e-3 * best:.5g} kW with the best aims")
        )
    print(
        f"heliostats: {answer['aimed']} with an aim, {answer['resting']} at standby without "
        f"one, {answer['waiting']} waiting for the ramp, {answer['left']} still to move"
    )
    for names, text in (
        (answer["by_hand"], "aimed by an operator and kept"),
        (answer["unlit"], "reaching no cell of the receiver"),
        (answer["moved"], f"moved {answer['moved_ago'] or 0.0:.0f} s ago"),
    ):
        if names:
            print(f"{len(names)} {text}: {', '.join(names[:10])}")


@app.command()
def show(
    context: typer.Context,
    what: Annotated[
        str,
        typer.Argument(
            help="alarms, events, packets, clusters, calibration, flights, learning, schedule, "
            "timetable, holds, retries, emergency, sun, accounts, tokens, or a heliostat's name."
        ),
    ],
) -> None:
    """Print a view of the plant as JSON."""
    from urllib.parse import quote

    known = (
        "alarms",
        "events",
        "packets",
        "clusters",
        "calibration",
        "flights",
        "learning",
        "schedule",
        "timetable",
        "holds",
        "retries",
        "emergency",
        "sun",
        "authority",
        "field",
        "accounts",
        "tokens",
    )
    path = what if what in known else f"heliostats/{quote(what, safe='')}"
    with _client(context) as client:
        print_json(client.get(path))


@app.command()
def flux(
    context: typer.Context,
    receiver: Annotated[
        str, typer.Argument(help="Receiver; default: the first.", show_default=False)
    ] = "",
    as_json: Json = False,
) -> None:
    """Print the predicted flux on a receiver, with its standard deviations."""
    from heliotrope.values import amount

    with _client(context) as client:
        name = receiver or (client.get("field")["receivers"] or [""])[0]
        if not name:
            raise InputError("ctl: the plant has no receiver")
        answer = client.get(f"receivers/{quote(name, safe='')}/flux")
    if as_json:
        print_json(answer)
        return
    print(f"{answer['receiver']}: {amount(answer['heliostats'], 'heliostat')}")
    print(f"power {_give_or_take(answer['power'], answer['power_sigma'], 'kW')}")
    print(f"peak {_give_or_take(answer['peak'], answer['peak_sigma'], 'kW/m²')}")
    if answer["intercept"] is not None:
        print(f"intercept {100 * answer['intercept']:.1f} %")


def _give_or_take(value: float, sigma: float | None, unit: str) -> str:
    """Return a value and, if known, its standard deviation, in thousands of its unit."""
    digits = f"{1e-3 * value:.0f}"
    return f"{digits} {unit}" if sigma is None else f"{digits} ± {1e-3 * sigma:.0f} {unit}"


@app.command()
def why(
    context: typer.Context,
    heliostat: Annotated[str, typer.Argument(help="Heliostat.")],
    as_json: Json = False,
) -> None:
    """Explain why a heliostat does or does not track, what happens next, and what you can do."""
    from urllib.parse import quote

    with _client(context) as client:
        answer = client.get(f"heliostats/{quote(heliostat, safe='')}/why")
    if as_json:
        print_json(answer)
        return
    print(answer["text"])
    for title, line in (("next", answer["follows"]), ("you can", answer["remedy"])):
        if line:
            print(f"{title}: {line}")
    if (order := answer["order"]) is not None:
        print(
            f"last order: {order['what']} by {order['who']} at {_utc(order['at'])}, {order['text']}"
        )
    for alarm in answer["alarms"]:
        print(f"{alarm['severity']}: {alarm['text']}")


@app.command()
def events(
    context: typer.Context,
    limit: Annotated[int, typer.Option(min=1, max=2000, help="Maximum number of events.")] = 50,
    all_names: Annotated[
        bool,
        typer.Option(
            "--all-names", help="Print the names of all heliostats that each event affects."
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Print the latest events since the start of the plant, newest first."""
    with _client(context) as client:
        events = client.get(f"events?limit={limit}")
        for event in events if all_names else ():
            if event["heliostats"]:
                event["names"] = client.get(f"events/{event['number']}/heliostats")
    if as_json:
        print_json(events)
        return
    for event in events:
        print(
            "  ".join(filter(None, (_utc(event["at"]), event["kind"], event["who"], event["text"])))
        )
        if "names" in event:
            print(f"    {', '.join(event['names'])}")


@app.command()
def journal(
    context: typer.Context,
    since: Annotated[str, typer.Option(help="From this time, ISO 8601.", show_default=False)] = "",
    until: Annotated[str, typer.Option(help="Before this time.", show_default=False)] = "",
    kind: Annotated[
        str, typer.Option(help="event, alarm, command or note.", show_default=False)
    ] = "",
    person: Annotated[str, typer.Option(help="Name of the user.", show_default=False)] = "",
    heliostat: Annotated[str, typer.Option(help="Heliostat.", show_default=False)] = "",
    text: Annotated[
        str, typer.Option(help="Text to search for, ignoring case.", show_default=False)
    ] = "",
    everybody: Annotated[
        bool, typer.Option("--all", help="Include the commands of automatic control.")
    ] = False,
    limit: Annotated[int, typer.Option(min=1, max=2000, help="Maximum number of entries.")] = 200,
    as_csv: Annotated[bool, typer.Option("--csv", help="Print CSV.")] = False,
) -> None:
    """Print events, alarms and commands of all days, newest first."""
    import csv
    import sys
    from urllib.parse import urlencode

    query = {"kind": kind, "person": person, "heliostat": heliostat, "text": text, "limit": limit}
    query["but"] = "" if everybody else "automatic control"
    for name, moment in (("since", since), ("until", until)):
        if moment:
            query[name] = f"{parse_time(moment).timestamp():.3f}"
    with _client(context) as client:
        entries = client.get(f"journal?{urlencode(query)}")
    rows = [(_utc(entry["at"]), entry["kind"], entry["what"], entry["text"]) for entry in entries]
    if as_csv:
        csv.writer(sys.stdout).writerows((("time", "kind", "what", "text"), *rows))
        return
    for row in rows:
        print("  ".join(row))
    if not rows:
        print("no entries found")


@app.command()
def report(
    context: typer.Context,
    since: Annotated[
        str,
        typer.Option(
            help="From this time, ISO 8601; default: 8 h before the end.", show_default=False
        ),
    ] = "",
    until: Annotated[
        str, typer.Option(help="Before this time; default: now.", show_default=False)
    ] = "",
    as_json: Json = False,
) -> None:
    """Print the shift report: production, availability, calibrations, alarms, work, notes."""
    bounds = {"since": since, "until": until}
    times = [f"{name}={parse_time(at).timestamp():.3f}" for name, at in bounds.items() if at]
    with _client(context) as client:
        answer = client.get("?".join(filter(None, ("report", "&".join(times)))))
    if as_json:
        print_json(answer)
        return
    print(f"{answer['plant']}, {_utc(answer['since'])} to {_utc(answer['until'])}")
    hours = answer["recorded"] / 3600.0
    print(f"records cover {hours:.1f} h of this period, {answer['daylight'] / 3600.0:.1f} h by day")
    for receiver in answer["production"]:
        print(
            f"{receiver['receiver']}: {receiver['energy'] / 3.6e9:.3f} MWh predicted, peak "
            f"{receiver['peak'] / 1e6:.2f} MW at {_utc(receiver['peak_at'])}"
        )
    if answer["availability"] is not None:
        print(f"availability {answer['availability']:.1%}; heliostat hours lost:")
        print_table(
            ("reason", "heliostat hours"),
            [(why, "-" if s is None else f"{s / 3600:.1f}") for why, s in answer["lacks"].items()],
        )
    rows = [(name.replace("_", " "), str(count)) for name, count in answer["outcomes"].items()]
    print_table(("visits", "number"), rows, "calibrations")
    for name in ("alarms", "locks", "work", "notes"):
        print(f"{name}: {len(answer[name])}")
        for entry in answer[name]:
            at = entry.get("at") or entry.get("raised") or entry["since"]
            print(f"  {_utc(at)}  {_line(entry)}")


def _line(entry: dict[str, Any]) -> str:
    """Return an alarm, a lock or an entry of the journal in one line."""
    if "who" in entry:
        return f"{entry['kind']} {entry['name']}: {entry['reason']} ({entry['who']})"
    over = f"; cleared at {_utc(entry['cleared'])}" if entry.get("cleared") else ""
    return f"{entry.get('condition', '')} {entry['text']}{over}".strip()


@app.command()
def trend(
    context: typer.Context,
    quantity: Annotated[
        str, typer.Argument(help="Name of a quantity; default: list the names.", show_default=False)
    ] = "",
    heliostat: Annotated[
        str, typer.Option(help="Heliostat, for a quantity of one heliostat.", show_default=False)
    ] = "",
    since: Annotated[
        str,
        typer.Option(
            help="From this time, ISO 8601; default: one day before the end.", show_default=False
        ),
    ] = "",
    until: Annotated[
        str, typer.Option(help="Before this time; default: now.", show_default=False)
    ] = "",
    points: Annotated[int, typer.Option(min=10, max=5000, help="Maximum number of points.")] = 1000,
) -> None:
    """Print a quantity over time as CSV: minimum, mean and maximum."""
    import csv
    import sys
    from urllib.parse import urlencode

    with _client(context) as client:
        if not quantity:
            rows = [
                (trend["name"], trend["unit"], "heliostat" if trend["heliostat"] else "plant")
                for trend in client.get("trends")
            ]
            print_table(("quantity", "unit", "of"), rows)
            return
        asked = {"quantity": quantity, "heliostat": heliostat, "points": points}
        for name, moment in (("since", since), ("until", until)):
            if moment:
                asked[name] = f"{parse_time(moment).timestamp():.3f}"
        answer = client.get(f"trend?{urlencode(asked)}")
    columns = [answer[key] for key in ("low", "mean", "high")]
    rows = list(zip(map(_utc, answer["at"]), *columns, strict=True))
    head = ("time", *(f"{name} ({answer['unit']})" for name in ("low", "mean", "high")))
    csv.writer(sys.stdout).writerows((head, *rows))


@app.command()
def note(
    context: typer.Context,
    text: Annotated[str, typer.Argument(help="What the next shift needs to know.")],
) -> None:
    """Store a note for the next shift, in the journal and the report."""
    with _client(context) as client:
        client.ask("POST", "notes", {"text": text})
    print("noted")


@app.command()
def stow(
    context: typer.Context, heliostats: Whom = None, everybody: All = False, wait: Wait = 0.0
) -> None:
    """Send heliostats to stow, without needing the command authority."""
    _give(context, "STOW", _names(heliostats, everybody), (), wait)


@app.command()
def defocus(
    context: typer.Context, heliostats: Whom = None, everybody: All = False, wait: Wait = 0.0
) -> None:
    """Move beams off the receiver, without needing the command authority."""
    _give(context, "DEFOCUS", _names(heliostats, everybody), (), wait)


@app.command()
def command(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="APPROACH, TRACK, IDLE, REFOCUS, LOCK, JOG, ...")],
    heliostats: Whom = None,
    everybody: All = False,
    value: Annotated[
        list[float] | None,
        typer.Option(
            min=-1e9, max=1e9, help="Arguments of the command, in order.", show_default=False
        ),
    ] = None,
    wait: Wait = 60.0,
) -> None:
    """Take the command authority, issue a command, await its completion, release the authority."""
    _give(context, name.upper(), _names(heliostats, everybody), tuple(value or ()), wait)


@app.command()
def aim(
    context: typer.Context,
    where: Annotated[
        str, typer.Argument(help="A receiver, a target, standby, or east,north,up in m.")
    ],
    heliostats: Whom = None,
    everybody: All = False,
    right: Annotated[
        float | None,
        typer.Option(
            min=-1e5,
            max=1e5,
            help=(
                "Point on the unrolled receiver: distance right of its centre as seen from "
                "outside, m."
            ),
            show_default=False,
        ),
    ] = None,
    up: Annotated[
        float | None,
        typer.Option(
            min=-1e5,
            max=1e5,
            help="Point on the unrolled receiver: height above its centre, m.",
            show_default=False,
        ),
    ] = None,
    wait: Wait = 60.0,
) -> None:
    """Aim heliostats at a receiver or a point on it, a target, standby, or a point in space."""
    names = _names(heliostats, everybody)
    order: dict[str, Any] = {"heliostats": names, "where": where}
    if where == "standby":
        _give(context, "IDLE", names, (), wait)
        return
    if right is not None or up is not None:
        order |= {"right": right or 0.0, "up": up or 0.0}
    if "," in where:
        if not names:
            raise InputError("ctl: a point needs named heliostats, not --all")
        order = {"points": dict.fromkeys(names, parse_point(where, "aim"))}
    with _client(context) as client:
        _follow_with_authority(client, "aim", order, wait)


@app.command()
def standby(
    context: typer.Context,
    points: Annotated[
        Path, typer.Argument(help="Standby points (CSV), as written by `heliotrope standby`.")
    ],
    wait: Wait = 60.0,
) -> None:
    """Set standby points of heliostats; each is checked against volumes and eyes."""
    from heliotrope.field.points import read_points

    order = {"points": {name: point.tolist() for name, point in read_points(points).items()}}
    with _client(context) as client:
        _follow_with_authority(client, "standby", order, wait)


@app.command()
def emergency(
    context: typer.Context,
    act: Annotated[str, typer.Option(help="DEFOCUS or STOW.")] = "DEFOCUS",
    reason: Annotated[str, typer.Option(help="Reason, recorded in the audit log.")] = "",
    withdraw: Annotated[
        bool, typer.Option("--withdraw", help="Withdraw your order instead.")
    ] = False,
    owner: Annotated[
        str,
        typer.Option(help="With --withdraw, engineers only: the user whose order is withdrawn."),
    ] = "",
) -> None:
    """Move all beams off the receiver now."""
    with _client(context) as client:
        if withdraw:
            answer = client.ask("DELETE", "emergency", {"owner": owner})
        else:
            answer = client.ask("POST", "emergency", {"act": act.upper(), "reason": reason})
    print(f"emergency {'in force' if answer['on'] else 'not in force'}: {answer['text']}")
    _print_causes(answer)


def _print_causes(answer: dict[str, Any]) -> None:
    """Print operators' active orders or, if there are none, why an emergency is active."""
    for call in answer["calls"]:
        print(f"ordered by {call['who']} ({call['act']}, {_utc(call['at'])}): {call['reason']}")
    if answer["on"] and not answer["calls"]:
        print(answer["reason"])


@app.command()
def acknowledge(
    context: typer.Context,
    condition: Annotated[
        str, typer.Argument(help="Condition of the alarm, as listed by `ctl list alarms`.")
    ],
    subject: Annotated[str, typer.Argument(help="Subject of the alarm, if it has one.")] = "",
) -> None:
    """Acknowledge an alarm."""
    with _client(context) as client:
        client.ask("POST", "alarms/acknowledge", {"condition": condition, "subject": subject})
    print(f"acknowledged {condition} {subject}".rstrip())


@app.command()
def calibration(
    context: typer.Context,
    on: Annotated[bool, typer.Option("--on/--off", help="On or off.")],
) -> None:
    """Switch automatic calibration on or off."""
    with _client(context) as client:
        answer = client.ask("PUT", "calibration", {"on": on})
    print(f"calibration {'on' if answer['on'] else 'off'}; {answer['done']} calibrated")


@app.command()
def calibrate(
    context: typer.Context,
    heliostats: Annotated[list[str], typer.Argument(help="Heliostats.")],
    target: Annotated[str, typer.Option(help="Target; default: any.")] = "",
    search: Annotated[
        bool, typer.Option("--search", help="Only search for the beam with the camera.")
    ] = False,
    together: Annotated[
        bool,
        typer.Option(
            "--together", help="Calibrate all of them together on one target, in a joint visit."
        ),
    ] = False,
    receiver: Annotated[
        bool,
        typer.Option(
            "--receiver",
            help="Calibrate all of them while they track the receiver, in a receiver visit.",
        ),
    ] = False,
    wait: Wait = 3600.0,
) -> None:
    """Have automatic control calibrate heliostats next, and wait for the results."""
    if search and (together or receiver):
        raise InputError(
            "calibrate: --search looks for one beam; leave out --together and --receiver"
        )
    if receiver and (together or target):
        raise InputError("calibrate: --receiver needs no target; leave out --target and --together")
    with _client(context) as client:
        first = heliostats[:1] if together or receiver else heliostats
        tickets = []
        for name in first:
            order = {"heliostat": name, "target": target, "search": search, "receiver": receiver}
            if together or receiver:
                order["together"] = heliostats[1:]
            tickets.append(client.ask("POST", "calibration/next", order))
        _follow_all(client, tickets, wait)


@app.command("parameters")
def error_parameters(
    context: typer.Context,
    heliostat: Annotated[str, typer.Argument(help="Heliostat.")],
    values: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME=VALUE]…",
            help="New values; default: show the current values.",
            show_default=False,
        ),
    ] = None,
    reason: Annotated[str, typer.Option(help="Reason, stored with the values.")] = "",
    version: Annotated[
        int, typer.Option(min=0, max=1_000_000_000, help="Restore this earlier version.")
    ] = 0,
    wait: Wait = 60.0,
    as_json: Json = False,
) -> None:
    """Show or set the error parameters of a heliostat at stow, locked or at rest.

    If the plant file requires a second approval, changes wait for it; see `ctl approvals`. Angles
    are in mrad and lengths in mm; NAME_deg=VALUE is in degrees.
    """
    from urllib.parse import quote

    order = {"heliostat": heliostat, "reason": reason, "version": version}
    with _client(context) as client:
        if not values and not version:
            answer = client.get(f"heliostats/{quote(heliostat, safe='')}/parameters")
            _show_parameters(answer, as_json)
            if answer["approval"] and not as_json:
                mine = (w for w in client.get("parameters/waiting") if w["heliostat"] == heliostat)
                _show_waiting(list(mine))
            return
        if not reason.strip():
            raise InputError("ctl: new parameters need a reason; add --reason")
        answer = client.get(f"heliostats/{quote(heliostat, safe='')}/parameters")
        units = {parameter["name"]: parameter["unit"] for parameter in answer["parameters"]}
        order["values"] = dict(_parameter(text, units) for text in values or ())
        if answer["approval"]:
            print(client.ask("POST", "parameters", order)["text"])
        else:
            _follow_with_authority(client, "parameters", order, wait)


@app.command()
def approvals(
    context: typer.Context,
    number: Annotated[
        int,
        typer.Argument(
            min=0, max=2**53, help="Number of the change; default: list all.", show_default=False
        ),
    ] = 0,
    approve: Annotated[
        bool, typer.Option("--approve", help="Approve the change and write it.")
    ] = False,
    refuse: Annotated[
        bool, typer.Option("--refuse", help="Refuse the change; needs --reason.")
    ] = False,
    withdraw: Annotated[bool, typer.Option("--withdraw", help="Withdraw your own change.")] = False,
    reason: Annotated[str, typer.Option(help="Reason for the refusal.")] = "",
    wait: Wait = 60.0,
    as_json: Json = False,
) -> None:
    """List parameter changes that await a second engineer; approve, refuse or withdraw one.

    The author or the approver must hold the command authority; otherwise it is taken briefly.
    """
    if (approve + refuse + withdraw > 1) or bool(number) != (approve or refuse or withdraw):
        raise InputError(
            "ctl approvals: use NUMBER together with --approve, --refuse or --withdraw"
        )
    if refuse and not reason.strip():
        raise InputError("ctl approvals: --refuse needs a reason; add --reason")
    path = f"parameters/waiting/{number}"
    with _client(context) as client:
        waiting = client.get("parameters/waiting")
        if not number:
            _show_waiting(waiting, as_json)
        elif withdraw:
            client.ask("DELETE", path)
            print(f"change {number} withdrawn")
        elif refuse:
            client.ask("POST", f"{path}/refuse", {"reason": reason})
            print(f"change {number} refused")
        elif client.get("authority")["holder"] in [
            change["author"] for change in waiting if change["number"] == number
        ]:
            _follow(client, client.ask("POST", f"{path}/approve"), wait, keeping=False)
        else:
            _follow_with_authority(client, f"{path}/approve", None, wait)


def _show_waiting(waiting: list[dict[str, Any]], as_json: bool = False) -> None:
    """Print the changes that await a second engineer."""
    if as_json:
        print_json(waiting)
        return
    for change in waiting:
        print(
            f"change {change['number']} of {change['heliostat']}, requested by {change['author']} "
            f"at {_utc(change['at'])}: {change['reason']}; it expires at {_utc(change['until'])}"
        )
        if change["version"]:
            print(f"this restores version {change['version']}")
        rows = []
        for parameter in change["parameters"]:
            unit, size = _SHOWN[parameter["unit"]]
            shown = (f"{parameter[key] / size:.3f}" for key in ("now", "asked"))
            rows.append((parameter["name"], *shown, unit))
        print_table(("parameter", "in use", "requested", "unit"), rows)
        if change["beam_rms"] is not None:
            print(
                f"the beam moves by {1e3 * change['beam_rms']:.1f} mm RMS at its aim, at most "
                f"{1e3 * change['beam_most']:.1f} mm"
            )
    if not waiting:
        print("no changes are waiting for approval")


@app.command("plant-file")
def plant_file(
    context: typer.Context,
    check: Annotated[
        Path | None,
        typer.Option("--check", help="File to check.", show_default=False),
    ] = None,
    store: Annotated[
        Path | None,
        typer.Option("--store", help="New file that replaces the plant file.", show_default=False),
    ] = None,
    versions: Annotated[bool, typer.Option("--versions", help="List the stored versions.")] = False,
    version: Annotated[str, typer.Option(help="Print this stored version.")] = "",
    waiting: Annotated[
        bool,
        typer.Option(
            "--waiting", help="Show the new file that awaits a second engineer's approval."
        ),
    ] = False,
    approve: Annotated[
        int, typer.Option(min=0, max=2**53, help="Approve the waiting file with this number.")
    ] = 0,
    refuse: Annotated[
        int,
        typer.Option(
            min=0, max=2**53, help="Refuse the waiting file with this number; needs --reason."
        ),
    ] = 0,
    withdraw: Annotated[
        int, typer.Option(min=0, max=2**53, help="Withdraw your own waiting file with this number.")
    ] = 0,
    reason: Annotated[
        str, typer.Option(help="Reason for the change, recorded with the new file.")
    ] = "",
    replaces: Annotated[
        str,
        typer.Option(help="Version that the new file was edited from; default: the current one."),
    ] = "",
    as_json: Json = False,
) -> None:
    """Print the plant file that the running plant uses; check or store a new one.

    Nothing moves. A file that changes only views of cameras and marks on targets takes effect at
    once, and then needs the command authority; any other change takes effect when the plant
    restarts.
    """
    chosen = (check, store, versions, version, waiting, approve, refuse, withdraw)
    if sum(map(bool, chosen)) > 1:
        raise InputError("ctl plant-file: use only one option besides --reason and --replaces")
    if (store or refuse) and not reason.strip():
        raise InputError("ctl plant-file: a reason is needed; add --reason")
    with _client(context) as client:
        if approve or refuse or withdraw:
            _decide_plant_file(client, approve, refuse, withdraw, reason)
        elif version:
            print(client.get(f"plant-file/versions/{quote(version, safe='')}"), end="")
        elif check is not None:
            _check_plant_file(client, check, as_json)
        elif store is not None:
            text = _toml_of(store)
            based = replaces or client.get("plant-file")["version"]
            order = {"text": text, "version": based, "reason": reason}
            print(client.ask("PUT", "plant-file", order)["text"])
        else:
            _show_plant_file(client.get("plant-file"), versions, waiting, as_json)


def _toml_of(path: Path) -> str:
    from heliotrope.field.formats.plant_text import plant_text

    return plant_text(path)


def _decide_plant_file(
    client: "AtPlant | Client", approve: int, refuse: int, withdraw: int, reason: str
) -> None:
    """Decide on the text that waits for a second engineer."""
    path = f"plant-file/waiting/{approve or refuse or withdraw}"
    if approve:
        print(client.ask("POST", f"{path}/approve")["text"])
    elif refuse:
        client.ask("POST", f"{path}/refuse", {"reason": reason})
        print(f"change {refuse} refused")
    else:
        client.ask("DELETE", path)
        print(f"change {withdraw} withdrawn")


def _check_plant_file(client: "AtPlant | Client", path: Path, as_json: bool) -> None:
    """Print what the plant finds in a text; the exit code is 1 if it cannot be stored."""
    answer = client.ask("POST", "plant-file/check", {"text": _toml_of(path)})
    if as_json:
        print_json(answer)
    else:
        for finding in answer["findings"]:
            line = f"line {finding['line']}: " if finding["line"] else ""
            print(f"{finding['severity']}: {line}{finding['text']}")
        print("\n".join(answer["difference"]) or "no difference from the current file")
        _print_differs(answer["differs"])
        if answer["good"]:
            print(
                "takes effect immediately"
                if answer["at_once"]
                else "takes effect when the plant restarts"
            )
    if not answer["good"]:
        raise typer.Exit(1)


def _print_differs(differs: list[dict[str, Any]]) -> None:
    """Print the tables that differ from the text in use."""
    for one in differs:
        keys = f" ({', '.join(one['keys'])})" if one["keys"] else ""
        print(f"{one['how']}: {one['table']} {one['name']}".rstrip() + keys)


def _show_plant_file(view: dict[str, Any], versions: bool, waiting: bool, as_json: bool) -> None:
    """Print the plant file, its versions, or the text that waits."""
    if as_json:
        print_json(view)
    elif versions:
        print_table(("version", ""), [(one["name"], one["note"]) for one in view["versions"]])
    elif not waiting:
        print(view["text"], end="")
    elif (one := view["waiting"]) is None:
        print("no file is waiting for approval")
    else:
        print(
            f"change {one['number']} of the plant file, requested by {one['author']} at "
            f"{_utc(one['at'])}: {one['reason']}; it expires at {_utc(one['until'])}"
        )
        print("\n".join(one["difference"]))


#: Displayed units: name, and size in the unit of the API.
_SHOWN = {"rad": ("mrad", 1e-3), "m": ("mm", 1e-3), "1": ("", 1.0)}


def _parameter(text: str, units: dict[str, str]) -> tuple[str, float]:
    """Return the name and value from a text NAME=VALUE, in the API's unit."""
    key, _, number = text.partition("=")
    name = key
    for ending in ("_mrad", "_mm", "_deg"):
        name = name.removesuffix(ending)
    if name not in units:
        raise UnknownNameError("parameter", name, units)
    size = 0.017453292519943295 if key.endswith("_deg") else _SHOWN[units[name]][1]
    refusal = f"{text!r}: write NAME=VALUE with a number, {_SHOWN[units[name]][0]}"
    return name, parse_numbers(number, refusal)[0] * size


def _show_parameters(answer: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print_json(answer)
        return
    rows = []
    for parameter in answer["parameters"]:
        unit, size = _SHOWN[parameter["unit"]]
        values = (parameter["file"], parameter["value"], parameter["sigma"], parameter["prior"])
        shown = ("" if v is None else f"{v / size:.3f}" for v in values)
        rows.append((parameter["name"], *shown, unit))
    head = ("parameter", "plant file", "in use", "σ", "σ installed", "unit")
    print_table(head, rows, f"{answer['heliostat']}, version {answer['version']}")
    print(f"stored in its local controller: {answer['stored']}")
    lines = [
        (str(e["version"]), _utc(e["at"]), e["person"], str(e["sightings"]), e["note"])
        for e in answer["earlier"]
    ]
    if lines:
        print_table(("earlier version", "time", "person", "sightings", "note"), lines)


@app.command()
def versions(
    context: typer.Context,
    heliostat: Annotated[str, typer.Argument(help="Heliostat.")],
    first: Annotated[
        int, typer.Argument(min=0, max=1_000_000_000, help="First version; 0: the plant file.")
    ],
    second: Annotated[
        int | None,
        typer.Argument(
            min=0,
            max=1_000_000_000,
            help="Second version; default: the version in use.",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare two versions of a heliostat's error parameters and their effect on the beam."""
    path = f"heliostats/{quote(heliostat, safe='')}"
    with _client(context) as client:
        if second is None:
            second = client.get(f"{path}/parameters")["version"]
        answer = client.get(f"{path}/versions?first={first}&second={second}")
    if as_json:
        print_json(answer)
        return
    rows = []
    for one in answer["parameters"]:
        unit, size = _SHOWN[one["unit"]]
        values = [one[key] for key in ("first", "first_sigma", "second", "second_sigma")]
        shown = ["" if v is None else f"{v / size:.3f}" for v in values]
        change = (one["second"] - one["first"]) / size
        rows.append((one["name"], *shown, f"{change:+.3f}", unit))
    for which in ("first", "second"):
        one = answer[which]
        at = "" if one["at"] is None else f"{_utc(one['at'])}, {one['sightings']} sightings "
        print(f"version {one['version']}: {at}{one['person']} {one['note']}".rstrip())
    head = ("parameter", f"version {first}", "σ", f"version {second}", "σ", "change", "unit")
    print_table(head, rows, answer["heliostat"])
    if answer["beam_rms"] is not None:
        print(
            f"the beam moves by {1e3 * answer['beam_rms']:.1f} mm RMS at its aim today, at most "
            f"{1e3 * answer['beam_most']:.1f} mm"
        )


@app.command()
def photograph(
    context: typer.Context,
    target: Annotated[str, typer.Argument(help="Target.")],
) -> None:
    """Photograph a target now, and print the evaluation of the photograph."""
    from urllib.parse import quote

    with _client(context) as client:
        answer = client.ask("POST", f"targets/{quote(target, safe='')}/photograph")
    print(f"{target}, photograph {answer['version']}", *answer["reading"], sep="\n")


@app.command()
def photographs(
    context: typer.Context,
    heliostat: Annotated[
        str, typer.Argument(help="Heliostat; default: photographs requested by operators.")
    ] = "",
    limit: Annotated[
        int, typer.Option(min=1, max=10_000, help="Maximum number of photographs, newest first.")
    ] = 50,
    save: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the first and last photograph of the last calibration, as JPEG.",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """List the stored photographs of a heliostat, each with the result of its calibration visit."""
    if save is not None and not heliostat:
        raise InputError("ctl photographs: --save needs the name of a heliostat")
    with _client(context) as client:
        answer = client.get(f"photographs?heliostat={quote(heliostat, safe='')}&limit={limit}")
        if save is not None:
            _save_calibration(client, heliostat, answer, save)
            return
    if as_json:
        print_json(answer)
        return
    rows = [
        (str(p["identity"]), _utc(p["at"]), p["target"], p["outcome"], p["text"]) for p in answer
    ]
    print_table(("number", "time", "target", "outcome", ""), rows)


def _save_calibration(
    client: "Client | AtPlant", heliostat: str, kept: list[dict[str, Any]], folder: Path
) -> None:
    """Save the first and last photographs of a heliostat's last calibration, as the page does.

    Raises
    ------
    InputError
        If the heliostat has no result or no stored photograph, or the folder cannot be written.
    """
    results = client.get(f"heliostats/{quote(heliostat, safe='')}")["results"]
    if not results:
        raise InputError(f"{heliostat}: no calibration result yet")
    *_, before, last = [{"at": 0.0}, *sorted(results, key=lambda result: result["at"])]
    mine = [picture for picture in kept if before["at"] < picture["at"] <= last["at"] + 1.0]
    mine.sort(key=lambda picture: picture["at"])
    if not mine:
        raise InputError(f"{heliostat}: no photograph from its last calibration is available")
    print(f"{last['outcome']}, {_utc(last['at'])}, {last['target']}: {last['text']}")
    name = re.sub(r"[^\w.-]", "_", heliostat)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for which, picture in zip(
            ("first", "last"), (mine[0], mine[-1])[: len(mine)], strict=False
        ):
            at = datetime.fromtimestamp(picture["at"], UTC)
            path = folder / f"{name}-{at:%Y%m%dT%H%M%SZ}-{which}.jpg"
            path.write_bytes(client.picture(f"photographs/{picture['identity']}"))
            print(path)
    except OSError as error:
        raise InputError(f"ctl photographs: {error.filename}: {error.strerror}") from None


@app.command()
def frames(
    context: typer.Context,
    cluster: Annotated[str, typer.Argument(help="Cluster.")],
    heliostat: Annotated[
        str, typer.Option(help="Only frames to and from this heliostat, and broadcasts.")
    ] = "",
    as_json: Json = False,
) -> None:
    """Record the frames on a cluster's bus for five seconds, and print them in decoded form."""
    from urllib.parse import quote

    with _client(context) as client:
        answer = client.ask("POST", f"clusters/{quote(cluster, safe='')}/frames")
    if heliostat:
        answer = [frame for frame in answer if frame["whom"] in (heliostat, "all", "")]
    if as_json:
        print_json(answer)
        return
    rows = [
        (
            datetime.fromtimestamp(frame["at"], UTC).strftime("%H:%M:%S.%f")[:-3],
            frame["way"],
            frame["whom"],
            frame["kind"] + (" (signed)" if frame["signed"] else ""),
            str(frame["sequence"]),
            str(frame["size"]),
            frame["text"],
        )
        for frame in answer
    ]
    print_table(("time", "way", "heliostat", "kind", "number", "bytes", ""), rows)


@app.command()
def flight(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="flight.json of `heliotrope drone evaluate`.")],
    name: Annotated[str, typer.Option(help="Another name for the flight.")] = "",
) -> None:
    """Import a drone flight; the plant then fits all its heliostats, without moving any."""
    from heliotrope.calibration.flights import read_flight

    document = read_flight(file).model_dump()
    with _client(context) as client:
        answer = client.ask("POST", "flights", {**document, "name": name or document["name"]})
    print(
        f"flight {answer['name']}: {answer['orientations']} orientations of {answer['heliostats']} "
        f"heliostats"
    )
    print(
        f"new parameters: {answer['in_use']} in use, {answer['at_stow']} when next at stow, "
        f"{answer['at_target']} after a photograph on a target; {answer['unchanged']} unchanged"
    )
    rows = [(word, f"{value:+.2g}", f"{sigma:.2g}") for word, value, sigma in answer["shared"]]
    print_table(("shared error", "found", "σ"), rows)
    for line in answer["problems"]:
        print(line)


@app.command()
def learn(
    context: typer.Context,
    group: Annotated[
        str, typer.Option(help="Group of the plant file.", show_default="all groups")
    ] = "",
) -> None:
    """Learn drift, noise and installation errors now, as is done at night, without any motion."""
    with _client(context) as client:
        answer = client.ask("POST", "learning", {"group": group})
    for entry in answer:
        print(f"group {entry['group']}: {entry['said']}")
        print(f"  in force: {entry['drift']}")


@app.command()
def timetable(
    context: typer.Context,
    name: Annotated[
        str, typer.Argument(help="Entry to set or remove; default: show all.", show_default=False)
    ] = "",
    heliostats: Whom = None,
    target: Annotated[str, typer.Option(help="Target; default: any.")] = "",
    at: Annotated[
        list[str] | None,
        typer.Option(
            help="Time of day with its zone, such as 08:30Z or 10:30+02:00.", show_default=False
        ),
    ] = None,
    every: Annotated[
        str,
        typer.Option(
            help="Interval counted from midnight UTC, such as 10min or 2h.", show_default=False
        ),
    ] = "",
    rule: Annotated[
        str,
        typer.Option(
            help="Instead of times: first (before others) or never (only when an operator "
            "requests it).",
            show_default=False,
        ),
    ] = "",
    remove: Annotated[bool, typer.Option("--remove", help="Remove the entry.")] = False,
    plant_file: Annotated[
        bool, typer.Option("--plant-file", help="Restore the timetable of the plant file.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Show or change the calibrations that are scheduled at times of day or at intervals."""
    gives = bool(heliostats or target or at or every or rule)
    if plant_file and (name or gives or remove):
        raise InputError("ctl timetable: --plant-file cannot be combined with other options")
    if bool(name) != (gives or remove):
        raise InputError(
            "ctl timetable: use NAME HELIOSTAT… with --at, --every or --rule, or NAME --remove"
        )
    with _client(context) as client:
        answer = client.get("timetable")
        if plant_file or name:
            entries = None if plant_file else _entries(answer, name, remove)
            if entries is not None and gives:
                seconds = parse_duration(every).total_seconds() if every else None
                entry = {"name": name, "heliostats": heliostats or [], "target": target}
                entries.append({**entry, "at": at or [], "every_s": seconds, "rule": rule})
            answer = client.ask("PUT", "timetable", {"entries": entries})
    if as_json:
        print_json(answer)
        return
    rows = [
        (
            row["name"],
            ", ".join(row["heliostats"][:3]) + ("…" if len(row["heliostats"]) > 3 else ""),
            row["target"] or "any",
            ", ".join(row["at"]) + (f" every {row['every_s']:g} s" if row["every_s"] else ""),
            row["rule"] or _utc(row["next"]),
            row["text"] or ("" if row["rule"] else "not due yet"),
        )
        for row in answer
    ]
    print_table(("entry", "heliostats", "target", "at", "next", "last"), rows, "timetable")


def _entries(in_force: list[dict[str, Any]], name: str, remove: bool) -> list[dict[str, Any]]:
    """Return all entries in force except one, in the form that the API accepts."""
    if remove and name not in [entry["name"] for entry in in_force]:
        raise UnknownNameError("timetable entry", name, [entry["name"] for entry in in_force])
    keys = ("name", "heliostats", "target", "at", "every_s", "rule")
    return [{key: entry[key] for key in keys} for entry in in_force if entry["name"] != name]


@app.command()
def reading(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the reading in the safety table.")],
    value: Annotated[
        float,
        typer.Argument(
            min=-1e9, max=1e9, help="Value measured now, in the unit that the safety table states."
        ),
    ],
) -> None:
    """Submit a sensor reading to the safety table, if the links file has "api" as its source."""
    from urllib.parse import quote

    with _client(context) as client:
        order = {"value": value, "at": time.time()}
        client.ask("PUT", f"readings/{quote(name, safe='')}", order)


@app.command("out-of-service")
def out_of_service(
    context: typer.Context,
    reason: Annotated[str, typer.Option(help="Reason, shown to all users.")],
    heliostats: Whom = None,
    targets: LockedTargets = None,
    receivers: LockedReceivers = None,
    tower: LockedTower = False,
    hours: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            max=87_600,
            help="Hours until the expected return to service.",
            show_default=False,
        ),
    ] = None,
    wait: Wait = 600.0,
) -> None:
    """Lock heliostats, targets, receivers or the tower, and wait until all are parked."""
    order = {**_places(heliostats, targets, receivers, tower), "reason": reason, "hours": hours}
    with _client(context) as client:
        _follow_all(client, [client.ask("POST", "holds", order)], wait)


@app.command("give-back")
def give_back(
    context: typer.Context,
    heliostats: Whom = None,
    targets: LockedTargets = None,
    receivers: LockedReceivers = None,
    tower: LockedTower = False,
    owner: Annotated[
        str, typer.Option(help="Engineers only: the user whose lock is removed; needs --reason.")
    ] = "",
    reason: Annotated[str, typer.Option(help="Reason for removing another user's lock.")] = "",
) -> None:
    """Remove your locks, without any motion; an object is in service once no lock is left."""
    order = {**_places(heliostats, targets, receivers, tower), "owner": owner, "reason": reason}
    with _client(context) as client:
        left = client.ask("POST", "holds/release", order)
    locked = ", ".join(f"{one['name']} ({one['who']}: {one['reason']})" for one in left)
    print(f"lock removed; still locked: {locked}" if left else "lock removed; no lock is left")


def _places(
    heliostats: list[str] | None,
    targets: list[str] | None,
    receivers: list[str] | None,
    tower: bool,
) -> dict[str, object]:
    """Return the objects that an operator locks or unlocks, in the form that the API accepts."""
    named = {"heliostats": heliostats, "targets": targets, "receivers": receivers}
    return {key: list(names or ()) for key, names in named.items()} | {"tower": tower}


@app.command()
def automatic(
    context: typer.Context, heliostats: Whom = None, everybody: All = False, wait: Wait = 600.0
) -> None:
    """Hand heliostats to automatic control; wait until they follow, or print why they do not."""
    names = _names(heliostats, everybody)
    with _client(context) as client:
        _follow_all(client, [client.ask("POST", "automatic", {"heliostats": names})], wait)


@app.command()
def resume(context: typer.Context) -> None:
    """Resume automatic control after many heliostats were lost."""
    with _client(context) as client:
        client.ask("POST", "automatic/resume")
        holder = client.get("authority")["holder"]
    waits = holder and holder != "automatic control"
    print(
        "automatic control resumed"
        + (f"; it continues as soon as {holder} releases command authority" if waits else "")
    )


def _utc(at: float) -> str:
    return datetime.fromtimestamp(at, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _names(heliostats: list[str] | None, everybody: bool) -> list[str]:
    if bool(heliostats) == everybody:
        raise InputError("ctl: name heliostats, or use --all for the whole field")
    return heliostats or []


def _give(
    context: typer.Context, name: str, heliostats: list[str], values: tuple[float, ...], wait: float
) -> None:
    order = {"command": name, "heliostats": heliostats, "values": list(values)}
    with _client(context) as client:
        if name in ("STOW", "DEFOCUS"):
            _follow(client, client.ask("POST", name.lower(), {"heliostats": heliostats}), wait)
        else:
            _follow_with_authority(client, "commands", order, wait)


def _follow_with_authority(
    client: "Client | AtPlant", path: str, order: dict[str, Any] | None, wait: float
) -> None:
    """Issue an order that needs the command authority, and follow the order to its end.

    An authority that this person holds already, as in a page, is kept.
    """
    held = client.get("authority")["mine"]
    client.ask("POST", "authority")
    try:
        _follow(client, client.ask("POST", path, order), wait)
    finally:
        if not held:
            client.ask("DELETE", "authority")


def _follow_all(client: "Client | AtPlant", tickets: list[dict[str, Any]], wait: float) -> None:
    """Print the progress of operations to their ends; exit code 1 if any is not completed."""
    until, printed = time.monotonic() + wait, dict[str, str]()
    while True:
        for ticket in tickets:
            if printed.get(ticket["identity"]) != ticket["text"]:
                printed[ticket["identity"]] = ticket["text"]
                print(ticket["text"], flush=True)
        unfinished = [ticket["identity"] for ticket in tickets if not ticket["finished"]]
        if not unfinished or time.monotonic() >= until:
            break
        time.sleep(0.5)
        tickets = [
            client.get(f"commands/{ticket['identity']}")
            if ticket["identity"] in unfinished
            else ticket
            for ticket in tickets
        ]
    if wait > 0.0 and not all(ticket["good"] for ticket in tickets):
        raise typer.Exit(1)


def _follow(
    client: "Client | AtPlant", ticket: dict[str, Any], wait: float, keeping: bool = True
) -> None:
    """Wait for the end of a command and print its result; exit code 1 if it failed.

    With ``keeping``, the command authority is held until then, if the command needs it.
    """
    until = time.monotonic() + wait
    while not ticket["finished"] and time.monotonic() < until:
        time.sleep(0.5)
        ticket = client.get(f"commands/{ticket['identity']}")
        needed = keeping and ticket["command"] not in ("STOW", "DEFOCUS")
        if needed and not ticket["finished"]:
            client.ask("PUT", "authority")
    print(ticket["text"])
    if wait > 0.0 and not ticket["good"]:
        raise typer.Exit(1)
