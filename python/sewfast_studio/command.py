"""`sewfast studio`: from a recording to a controller on a local page."""

from __future__ import annotations

import argparse
from pathlib import Path

from sewfast.cli.arguments import Commands, add_command
from sewfast.cli.drive import is_port
from sewfast.cli.interrupts import patient
from sewfast.cli.output import print_json
from sewfast.errors import SettingError

TEXT = """\
Open a page in the browser: look at recordings, identify a model, validate it, draw Bode plots,
tune a controller, record, run and commission a drive.
Every step can be copied as Python or as commands, and its result is a file for the command line
(model.json, controller.json).
It needs the package websockets: pip install "sewfast[studio]". Only this computer can reach the
page, and only with the printed address; nothing is loaded from the network.
"""

EXAMPLES = """\
examples:
  sewfast studio                            the recordings of this folder
  sewfast studio recordings/run.csv         one of them first
  sewfast studio drive.json                 sliders for the controller of a model
  sewfast studio /dev/ttyUSB0               a drive, with this folder for its recordings
  sewfast studio --demo                     the same with a virtual machine, in a folder that
                                            is deleted afterwards
  sewfast studio --no-browser --port 8377   with ssh -L 8377:127.0.0.1:8377 from elsewhere
"""


OPTIONS = """\
place FOLDER|FILE|PORT  text?  project folder (this one), a recording or model in it, or the port of
    a drive
--demo  flag  records and a model of the virtual machine
--port N  int=0  default: a free one
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "studio", command,
        summary="look, identify, validate, tune on a local page",
        text=TEXT, options=OPTIONS, examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument(
        "--no-browser", dest="browser", action="store_false", help="only print the address"
    )


def command(args: argparse.Namespace) -> None:
    import contextlib
    import tempfile
    import threading
    import webbrowser

    from . import Project, Studio, make_demo

    if args.demo and args.place is not None:
        raise SettingError(f"--demo: expected no folder, received {args.place}; leave one out")
    # at its end the motor stops, what runs is cancelled, and the demo's folder goes
    with patient(), contextlib.suppress(KeyboardInterrupt), contextlib.ExitStack() as left:
        port = args.place if args.place is not None and is_port(args.place) else None
        place = "." if port is not None else args.place or "."
        if args.demo:
            # the page names the folder
            place = Path(left.enter_context(tempfile.TemporaryDirectory()), "demo")
            place.mkdir()
            make_demo(place)
        studio = left.enter_context(Studio(Project(place, demo=args.demo, port=port), args.port))
        if args.json:
            print_json({"address": studio.address, "folder": str(studio.project.folder)})
        else:
            print(f"{studio.address}\nCtrl-C ends it", flush=True)
        if args.browser:
            webbrowser.open(studio.address)
        studio.project.open_ahead()
        threading.Event().wait()
