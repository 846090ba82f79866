"""`python -m l2dgs_jax.sweep SPEC.toml OUT`: train a study of many scenes, seeds and settings."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import tyro

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime import command_line, devices, distributed
from l2dgs_jax.runtime.distributed import Hosts
from l2dgs_jax.study import report
from l2dgs_jax.study.running import run_study
from l2dgs_jax.study.spec import read


@dataclass(frozen=True)
class Sweep:
    """Train all members of a study and compare them in a table; one program trains members whose array shapes agree.

    Attributes:
        spec: TOML file with scenes, seeds and settings; docs/studies.md shows one.
        output: folder for the study: a run folder for each member, and results.json, .md and .png.
        resume: continue the study in the output folder from its last checkpoints.
        devices: number of devices to spread the members over; every CPU core is one. If not given, all.
        hosts: training on several hosts.
    """

    spec: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="STUDY.toml")]
    output: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    resume: bool = False
    devices: int | None = None
    hosts: Annotated[Hosts, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Hosts)


def main(arguments: Sequence[str]) -> None:
    """Sweep as the command line says."""
    devices.one_per_core()
    options = command_line.parse(Sweep, arguments, "sweep")
    if options.devices is not None and options.devices < 1:
        raise UserError(f"--devices {options.devices}: expected at least one")
    with distributed.process_group(options.hosts):
        output = options.output
        files = run_study(read(options.spec), output, resume=options.resume, device_count=options.devices)
        if jax.process_index() == 0:
            print((output / report.MARKDOWN).read_text())
            print(f"wrote {', '.join(str(output / name) for name in files)}")


if __name__ == "__main__":
    command_line.run(main, huge_pages=True)
