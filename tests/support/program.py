"""A program in a process of its own, whose lines are read as they are asked for."""

import re
import subprocess
import sys

#: The command line, as a program.
MAIN = "from heliotrope.cli import main; main()"


class Program:
    """A program in a process; its lines are read as they are asked for."""

    def __init__(self, *words: str) -> None:
        self.text = ""
        self.process = subprocess.Popen(
            [sys.executable, "-c", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def says(self, pattern: str) -> re.Match[str]:
        """Read lines until one matches."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.text += line
            if found := re.search(pattern, line):
                return found
        raise AssertionError(f"no {pattern!r} in\n{self.text}")

    def ends(self) -> int:
        """Read the rest, and return the exit code."""
        assert self.process.stdout is not None
        self.text += self.process.stdout.read()
        return self.process.wait(60.0)

    def close(self) -> None:
        """Kill it, if it runs."""
        self.process.kill()
        self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()
