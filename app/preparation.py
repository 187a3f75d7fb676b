"""The verb `prepare`: what a person is told while files are made of a sequence.

The work is in `pipelines.prepare`.
"""

from __future__ import annotations

import shlex
from argparse import Namespace
from typing import Any

from app import bootstrap, console
from app.runs import INTERRUPTED


def prepare(arguments: Namespace) -> int:
    """`prepare PATH`: 0 when all is there, 130 after Ctrl-C, whose files the next call keeps."""
    from pipelines.datasets import open_sequence
    from pipelines.io.config import load_config
    from pipelines.prepare import prepare as prepare_sequence

    config = load_config(arguments.config, arguments.overrides)
    if config.flow.name == "pwc_net":
        bootstrap.ensure_torch()
    counting = console.counting("preparing", arguments.quiet)
    with console.warnings(), counting as progress:
        sequence = open_sequence(arguments.path, arguments.dataset, arguments.sequence)
        try:
            done = prepare_sequence(
                sequence,
                config,
                arguments.output,
                what=arguments.what,
                frames=arguments.frames,
                overwrite=arguments.overwrite,
                progress=progress,
            )
        except KeyboardInterrupt:
            console.say("Stopped: what is written stays, and the same command goes on from there.")
            return INTERRUPTED
    folder = console.shorten(done.folder)
    if arguments.quiet:
        console.say(folder)
    else:
        _show(done)
        console.next_steps({"use it": f"run {shlex.quote(folder)}"})
    return 0


def _show(done: Any) -> None:
    rows = [(kind, f"{done.made[kind]} made", f"{done.kept[kind]} kept") for kind in done.made] + [
        (kind, "left out:", reason) for kind, reason in done.left_out.items()
    ]
    console.rows(rows)
    if done.skipped:
        console.say(f"{done.skipped} frames could not be read and were left out")
    console.say(f"\nPrepared: {console.shorten(done.folder)}")
