"""`python -m l2dgs_jax.prepare VIDEO_OR_FOLDER OUT`: find camera poses and points for a video, even a dark one."""

import dataclasses
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.capture import CaptureConfig, prepare, report
from l2dgs_jax.runtime import command_line


@dataclass(frozen=True)
class Prepare:
    """Make a scene for `train` from a video, or a folder of frames, that a moving camera has taken.

    Attributes:
        source: video, or folder of frames with numbered names.
        output: folder to create; intermediate results are kept in OUT.partial, from which the same command continues
            after an interruption.
        capture: how the video becomes a scene.
    """

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")]
    output: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    capture: Annotated[CaptureConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=CaptureConfig)


def main(arguments: Sequence[str]) -> None:
    """Prepare as the command line says."""
    options = command_line.parse(Prepare, arguments, "prepare")
    try:
        found = prepare(options.source, options.output, options.capture)
    except OSError as error:
        place = error.filename or options.output
        raise UserError(f"{place}: {error.strerror}; expected a readable source and a writable output") from None
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from here", file=sys.stderr)
        sys.exit(130)
    print(report.summary(found))
    scene = shlex.quote(str(options.output))
    print(f"next: look at {options.output / 'contact_sheet.png'}, then python -m l2dgs_jax.train {scene}")


if __name__ == "__main__":
    command_line.run(main)
