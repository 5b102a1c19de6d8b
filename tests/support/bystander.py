"""An operator who goes on with her work while a plant is attacked (`attacked_plant.py`)."""

import contextlib
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import httpx
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from support.attacked_plant import LONGEST, PASSWORD, Target
from support.attacks import Attack

#: Longest time for each step, s. A new holder of the command authority is known after 2.5 s.
WITHIN = {"sign in": 2.0, "stream": 2.0, "authority": 6.0, "order": 2.0, "back": 2.0,
          "emergency": 1.0, "withdraw": 2.0}  # fmt: skip
#: Growth of the memory of all processes that an attack may cause, MB.
GROWTH = 300.0
#: Time that an attack has before the operator comes, s.
_BEFORE = 3.0


@dataclass
class Steps:
    """How long each step took, s; infinite for one that failed, with its answer."""

    took: dict[str, float] = field(default_factory=dict)
    answers: dict[str, str] = field(default_factory=dict)
    growth: float = 0.0

    @contextlib.contextmanager
    def step(self, name: str) -> Iterator[list[httpx.Response]]:
        """Time a step, which puts its answer into the list."""
        answers: list[httpx.Response] = []
        begun = time.monotonic()
        try:
            yield answers
        except (httpx.HTTPError, WebSocketException, OSError) as error:
            self.took[name], self.answers[name] = math.inf, repr(error)
            return
        self.took[name] = time.monotonic() - begun
        for answer in answers:
            if answer.status_code >= 300:
                self.took[name] = math.inf
                self.answers[name] = f"{answer.status_code}: {answer.text[:200]}"

    def over(self) -> list[str]:
        """Return what took too long, failed, or took too much memory."""
        late = [
            f"{name}: {took:.2f} s {self.answers.get(name, '')}"
            for name, took in self.took.items()
            if took > WITHIN[name]
        ]
        return late + [f"memory: {self.growth:.0f} MB"] * (self.growth > GROWTH)


def order_emergency(target: Target, token: str, word: str) -> httpx.Response:
    """Order an emergency on the way of its own."""
    return httpx.post(
        f"http://127.0.0.1:{target.urgent}/api/v1/emergency",
        json={"reason": "a bystander", "call": word},
        headers={"Authorization": f"Bearer {token}"},
        timeout=LONGEST,
        trust_env=False,
    )


@contextlib.contextmanager
def signed_in(target: Target, name: str) -> Iterator[httpx.Client]:
    """Return a browser without a page of somebody who has signed in."""
    with httpx.Client(base_url=f"{target.url}api/v1/", trust_env=False, timeout=LONGEST) as client:
        answer = client.post("session", json={"name": name, "password": PASSWORD})
        answer.raise_for_status()
        client.headers["X-CSRF-Token"] = answer.json()["csrf"]
        yield client


@contextlib.contextmanager
def attacked(target: Target, *attacks: Attack, threads: int = 2) -> Iterator[None]:
    """Attack during a block."""
    over = threading.Event()
    works = [
        threading.Thread(target=attack, args=(target, over), daemon=True)
        for attack in attacks
        for _ in range(threads)
    ]
    for work in works:
        work.start()
    try:
        yield
    finally:
        over.set()
        for work in works:
            work.join(30.0)


def stand_by(target: Target, *attacks: Attack) -> Steps:
    """Return what Olga saw who came while the attacks had begun, and did all of her work."""
    if not target.withdraw():
        raise RuntimeError("the emergency before could not be withdrawn")
    found, before = Steps(), target.memory()
    name = ""
    with attacked(target, *attacks):
        time.sleep(_BEFORE)
        with httpx.Client(
            base_url=f"{target.url}api/v1/", trust_env=False, timeout=LONGEST
        ) as olga:
            with found.step("sign in") as answers:
                answers.append(olga.post("session", json={"name": "Olga", "password": PASSWORD}))
                olga.headers["X-CSRF-Token"] = answers[0].json().get("csrf", "")
            with found.step("stream"):
                cookie = "; ".join(f"{key}={value}" for key, value in olga.cookies.items())
                headers = {"Cookie": cookie}
                url = f"ws{target.url.removeprefix('http')}api/v1/live"
                with connect(url, additional_headers=headers, proxy=None) as line:
                    line.recv(LONGEST)
            with found.step("authority") as answers:
                answers.append(olga.post("authority"))
            name = olga.get("field").json()["names"][0]
            with found.step("order") as answers:
                answers.append(olga.post("stow", json={"heliostats": [name]}))
                order = {"command": "LOCK", "heliostats": [name]}
                answers.append(olga.post("commands", json=order))
                order = {"command": "UNLOCK", "heliostats": [name]}
                answers.append(olga.post("commands", json=order))
            with found.step("back") as answers:
                answers.append(olga.delete("authority"))
            with found.step("emergency") as answers:
                answers.append(order_emergency(target, target.unmet.pop(), f"{time.time()}"))
            with found.step("withdraw") as answers:
                answers.append(olga.request("DELETE", "emergency", json={}))
        found.growth = target.memory() - before
    return found
