"""Programs that enter a simulated plant by its one-time link."""

import httpx

from heliotrope.console.people import FIRST


def set_password(link: str, password: str) -> None:
    """Set the first password of the first account."""
    with httpx.Client(base_url=link.partition("enter")[0], trust_env=False, timeout=60.0) as client:
        assert client.get(link).status_code == 303
        who = client.get("api/v1/session").json()
        assert (who["name"], who["no_password"]) == (FIRST, True)
        client.headers["X-CSRF-Token"] = who["csrf"]
        answer = client.put("api/v1/session/password", json={"old": "", "new": password})
        assert answer.status_code == 204, answer.text
