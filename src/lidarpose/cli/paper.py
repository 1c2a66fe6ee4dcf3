"""`lidarpose paper`."""

import argparse
import io
from contextlib import redirect_stderr
from pathlib import Path

from lidarpose.cli.terminal import add_command, names, tell
from lidarpose.errors import InputError, check_name

_NAMES = ("table1", "table2", "table3", "table4", "fig5", "fig6", "fig7", "fig8")


def add(commands) -> None:
    """Adds the command to the parser's."""
    paper = add_command(
        commands,
        "paper",
        "run a table or figure of the paper",
        "lidarpose paper table1 --dry-run",
        "lidarpose paper table1 --people 200000 --workers 2",
        "lidarpose paper table3 --data waymo=prepared/waymo --size paper",
        description="Runs the commands behind a table, cell by cell, and writes NAME.md and NAME.json with what each "
        "cell cost; figures as NAME.png. What is done is not done again, and the same command continues after an "
        "interruption. Without --data synthesized people stand in for the real sets.",
    )
    paper.set_defaults(run=_paper)
    paper.add_argument("name", metavar="NAME", help="table1 to table4, or fig5 to fig8")
    paper.add_argument("--out", default="paper", metavar="DIR", help="folder of all tables (default paper)")
    paper.add_argument("--rows", metavar="A,B", help="only these rows, named as --dry-run names them")
    paper.add_argument("--dry-run", action="store_true", help="print the commands of every cell, run nothing")
    paper.add_argument("--table-only", action="store_true", help="write the table of what is there, run nothing")
    budget = paper.add_argument_group("budget")
    words = "people that a stage of training sees: pre-training, and fine-tuning on the stand-in (default 200000)"
    budget.add_argument("--people", type=int, default=200_000, metavar="N", help=words)
    words = "of a row's training in all: longer ones are made shorter, their schedule too"
    budget.add_argument("--hours", type=float, metavar="H", help=words)
    budget.add_argument("--seeds", type=int, default=1, metavar="K", help="seeds 0 ... K-1 of each cell (default 1)")
    budget.add_argument("--workers", type=int, default=1, metavar="N", help="of each command (default 1)")
    words = "widths of all networks: paper-small (default): reduced ones; or paper: as published"
    budget.add_argument("--size", default="paper-small", metavar="NAME", help=words)
    data = paper.add_argument_group("data")
    words = (
        "prepared real sets to learn from and to score on: waymo, humanm3, lidarhuman26m, sloper4d; to pre-train on: "
        "lipd, freemotion, noisemotion; raw poses: freemotion-poses, lidarhuman26m-poses"
    )
    data.add_argument("--data", metavar="NAME=DIR,...", help=words)
    words = "captured motion for synthesis; each is a row of table2, the first one is everywhere else"
    data.add_argument("--motion", metavar="FILE,FILE", help=words)
    data.add_argument("--subjects", metavar="A,B", help="subjects of the first file to learn from")
    data.add_argument("--held-out", metavar="A,B", help="its subjects whom the stand-in's target shows")


def _paper(options: argparse.Namespace) -> None:
    from lidarpose.cli import main
    from lidarpose.paper import figures
    from lidarpose.paper.report import plan, run_table, write_table
    from lidarpose.paper.steps import check_out
    from lidarpose.paper.tables import TABLES, Options, cells

    check_name("table or figure", options.name, _NAMES)
    wanted = {name: getattr(options, name) for name in ("people", "hours", "seeds", "workers", "size")}
    wanted |= {"subjects": options.subjects or "", "held_out": options.held_out or ""}
    asked = Options(data=_data(options.data), motion=names(options.motion or ""), **wanted)
    out = Path(options.out)
    check_out(out)
    if options.name == "fig6":
        if options.dry_run:
            print("# Figure 6: synthesized bodies\n\nDrawn at once; there is nothing to train.")
            return
        motion = asked.motion[0] if asked.motion else None
        print(figures.draw_one_body(out, seed=0, motion=motion))
        return
    table, chosen = TABLES[options.name], names(options.rows or "")
    selected = cells(table, asked, chosen)
    if options.dry_run:
        print(plan(table, selected, out, _problem), end="")
        return
    if options.table_only:
        write_table(table, selected, asked, out)
    else:
        run_table(table, asked, out, chosen, main, tell)
    print(out / f"{table.name}.md")
    if table.name.startswith("fig") and (path := figures.draw(table.name, selected, out)) is not None:
        print(path)


def _data(text: str | None) -> dict[str, str]:
    """name -> folder of "name=folder,name=folder"."""
    folders = {}
    for part in names(text or ""):
        name, equals, folder = part.partition("=")
        if not equals or not folder:
            raise InputError(f"expected --data NAME=DIR,..., got {part}")
        folders[name] = folder
    return folders


def _problem(words: list[str]) -> str:
    """What the command line's parser says against a command, "" for nothing."""
    from lidarpose.cli import _parser

    said = io.StringIO()
    try:
        with redirect_stderr(said):
            _parser().parse_args(words)
    except SystemExit:
        return said.getvalue().strip().removeprefix("lidarpose: error: ")
    return ""
