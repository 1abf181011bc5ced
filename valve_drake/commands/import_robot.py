"""`valve-drake import-robot`: a model folder and the draft of a robot.yaml from a URDF."""

import argparse
from pathlib import Path

from valve_drake import outputs
from valve_drake.commands.common import OK, Subcommands, check_rendering
from valve_drake.console import say


def add(commands: Subcommands) -> None:
    p = commands.add_parser(
        "import-robot",
        help="a model folder and the draft of a robot.yaml from a URDF",
        description="Makes DIR/NAME.urdf, DIR/meshes/*.obj, DIR/LICENSE and the draft DIR/robot.yaml, and says what it "
        "mended and what is left to fill in. Meshes are read by trimesh: pip install 'valve-drake[robots]'.",
    )
    p.add_argument("model", metavar="MODEL.urdf", help="a path, or package://NAME/path")
    p.add_argument("-o", "--out", type=Path, metavar="DIR", help="the folder (default: the robot's name)")
    p.add_argument("--overwrite", action="store_true", help="files in DIR may exist, robot.yaml too: they are replaced")
    p.add_argument("--picture", type=Path, metavar="PNG", help="a picture of the model, from ahead and from behind")
    p.add_argument("--json", action="store_true", help="print the report as one JSON object")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    from valve_drake.robot.importing import import_robot

    if options.picture:
        check_rendering()
    report = import_robot(options.model, options.out, options.overwrite, options.picture)
    if options.json:
        print(outputs.json_text(report.as_dict()))
    else:
        for line in report.lines():
            say(line)
    return OK
