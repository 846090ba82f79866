"""`l2dgs COMMAND ...`, or `python -m l2dgs_jax COMMAND ...`: the same as `python -m l2dgs_jax.COMMAND ...`."""

import runpy
import sys

COMMANDS = {
    "train": "train a scene from a dark video with poses",
    "evaluate": "score a run's held-out views",
    "render": "render a run's views, or a camera path through its scene, as pictures or videos",
    "view": "fly through a run in the browser",
    "export": "export a run's well-lit scene for splat viewers, or as a web page",
    "sweep": "train a study of many scenes, seeds and settings",
    "prepare": "find camera poses and points for your own video",
    "convert": "write a scene in another program's layout",
    "masks": "compute masks of what moves in a scene",
    "simulate": "make a low-light twin of a well-lit scene",
}


def main() -> None:
    """Run the command that the first argument names."""
    command, *arguments = sys.argv[1:] or ["--help"]
    if command in ("-h", "--help"):
        lines = [f"  {name:10}{what}" for name, what in COMMANDS.items()]
        print("\n".join(["usage: l2dgs COMMAND ...   (l2dgs COMMAND --help lists its options)", "", *lines]))
    elif command in COMMANDS:
        sys.argv = [f"l2dgs {command}", *arguments]
        runpy.run_module(f"l2dgs_jax.{command}", run_name="__main__", alter_sys=False)
    else:
        print(f"error: {command}: no such command; expected one of {', '.join(COMMANDS)}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
