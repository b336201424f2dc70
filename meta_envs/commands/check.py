"""`check`: every conformance check on an environment, a third party's too."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

from meta_envs.commands.mistake import mistakes

STYLES = {"passed": "green", "failed": "bold red", "skipped": "yellow"}


@dataclass(frozen=True)
class Check:
    """Put an environment to every conformance check; exit code 1 if it fails any."""

    env: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]
    """Environment: any of its names, or `module:Class` of a Definition of your own."""

    def run(self, console: Console) -> int:
        """Print a table of what passed and what failed, and why."""
        from meta_envs import conformance

        with contextlib.ExitStack() as stack:
            with mistakes():
                checked = stack.enter_context(conformance.subject(self.env))
            outcomes = []
            with console.status("Checking ...") as status:
                for outcome in conformance.run(checked):
                    outcomes.append(outcome)
                    status.update(f"Checked {len(outcomes)} of {len(conformance.CHECKS)} ...")
        table = Table("check", "result", "why", title=f"Conformance of {self.env}")
        table.title_justify = "left"
        for outcome in outcomes:
            result = Text(outcome.status, STYLES[outcome.status])
            # As Text, because square brackets in a string would be taken for markup.
            table.add_row(outcome.check, result, Text(outcome.reason))
        console.print(table)
        counts = {
            status: sum(outcome.status == status for outcome in outcomes) for status in STYLES
        }
        console.print(", ".join(f"{count} {status}" for status, count in counts.items()))
        return 1 if counts["failed"] else 0
