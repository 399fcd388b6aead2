"""`Diagnosis`: what was found wrong with a port and the device behind it, and what to do."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

Verdict: TypeAlias = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class Finding:
    """One thing that was examined.

    Parameters
    ----------
    name : str
    verdict : "ok", "warn" or "fail"
    measured : str
        What was found.
    remedy : str
        What to do; empty where nothing is to be done.
    values : dict
        The numbers in it, with units in their names.
    """

    name: str
    verdict: Verdict
    measured: str
    remedy: str = ""
    values: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        text = f"{self.verdict:<4}  {self.name:<14}{self.measured}"
        return f"{text}\n{'':20}-> {self.remedy}" if self.remedy else text


@dataclass(frozen=True)
class Diagnosis:
    """What `examine` found, in the order in which it looked; a failure may have ended it."""

    port: str
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> Verdict:
        """The worst of all."""
        verdicts = {f.verdict for f in self.findings}
        return "fail" if "fail" in verdicts else "warn" if "warn" in verdicts else "ok"

    def __getitem__(self, name: str) -> Finding:
        """The finding of a name; KeyError where it was not examined."""
        for finding in self.findings:
            if finding.name == name:
                return finding
        raise KeyError(name)

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "port": self.port,
            "verdict": self.verdict,
            "findings": [
                {
                    "name": f.name, "verdict": f.verdict, "measured": f.measured,
                    "remedy": f.remedy, **f.values,
                }
                for f in self.findings
            ],
        }  # fmt: skip

    def __str__(self) -> str:
        ends = {
            "ok": "nothing is wrong with it",
            "warn": "it works; see the warnings",
            "fail": "it does not work as it is; see the failures",
        }
        return "\n".join([*map(str, self.findings), f"{self.port}: {ends[self.verdict]}"])
