"""A real nginx of a test's own with the configuration of the documentation, and a stand-in of
oauth2-proxy, on this machine.
"""

import http.server
import os
import re
import shutil
import socket
import subprocess
import threading
import time
from pathlib import Path

NGINX = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin:/usr/local/sbin")
#: Address at which nginx listens: another one than the console's.
HERE = "127.0.0.2"
NAME = "plant.example.org"
_PATIENCE = 60.0
_AROUND = """
daemon off;
worker_processes 1;
pid {folder}/nginx.pid;
error_log {folder}/error.log;
events {{ worker_connections 512; }}
http {{
    access_log off;
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
{servers}
}}
"""


class SignIn:
    """Answers as oauth2-proxy's ``/oauth2/auth`` with ``--set-xauthrequest``: 202 or 401.

    Attributes
    ----------
    people
        Groups by name; the cookie ``_oauth2_proxy`` of a person is the name.
    """

    def __init__(self) -> None:
        self.people: dict[str, str] = {}
        known = self.people

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                found = re.search(r"_oauth2_proxy=(\w+)", self.headers.get("Cookie", ""))
                name = found[1] if found else ""
                if self.path != "/oauth2/auth":
                    self.answer(200, {}, b"sign in here")
                elif name not in known:
                    self.answer(401, {}, b"Unauthorized\n")
                else:
                    said = {
                        "User": f"subject-{name}",
                        "Email": f"{name}@example.org",
                        "Preferred-Username": name,
                        "Groups": known[name],
                    }
                    self.answer(202, {f"X-Auth-Request-{k}": v for k, v in said.items()}, b"")

            def answer(self, status: int, headers: dict[str, str], body: bytes) -> None:
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                pass

        class Server(http.server.ThreadingHTTPServer):
            daemon_threads = True
            request_queue_size = 128

        self._server = Server(("127.0.0.1", 0), Handler)
        self.port = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class Nginx:
    """nginx with servers of the documentation; `ports` are those of their ``listen``, in order."""

    def __init__(self, folder: Path, servers: str) -> None:
        self.folder = folder
        self.ports: list[int] = []
        servers = re.sub(r"listen [^;]*;", self._listen, servers)
        file = folder / "nginx.conf"
        text = _AROUND.format(folder=folder, servers=servers)
        # Started by root, its worker would be another user, who may not enter the folder.
        file.write_text(f"user root;{text}" if os.geteuid() == 0 else text)
        file.chmod(0o600)
        assert NGINX is not None
        self._process = subprocess.Popen(
            [NGINX, "-p", folder, "-c", file, "-e", folder / "error.log"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        deadline = time.monotonic() + _PATIENCE
        for port in self.ports:
            while True:
                try:
                    socket.create_connection((HERE, port)).close()
                    break
                except ConnectionRefusedError:
                    assert self._process.poll() is None, self.said()
                    assert time.monotonic() < deadline, self.said()
                    time.sleep(0.02)

    def _listen(self, _: "re.Match[str]") -> str:
        with socket.create_server((HERE, 0)) as free:
            self.ports.append(free.getsockname()[1])
        return f"listen {HERE}:{self.ports[-1]} ssl;"

    def said(self) -> str:
        return (self.folder / "error.log").read_text("utf-8")

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(_PATIENCE)
