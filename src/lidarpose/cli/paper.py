"""`lidarpose paper`."""

import argparse
import io
from collections.abc import Callable
from contextlib import redirect_stderr
from functools import partial
from pathlib import Path

from lidarpose.cli.terminal import add_command, names, tell
from lidarpose.errors import InputError, check_name, counted

_NAMES = ("table1", "table2", "table3", "table4", "fig5", "fig6", "fig7", "fig8")
_PAPER = """
run a table or figure of the paper
Runs the commands of a table, cell by cell, and writes NAME.md and NAME.json with the cost of each cell; figures as
 NAME.png. Finished steps are not repeated, and the same command resumes after an interruption. Without --data,
 synthesized people replace the real datasets.
$ lidarpose paper table1 --dry-run
$ lidarpose paper table1 --people 200000 --workers 2
$ lidarpose paper table3 --data waymo=prepared/waymo --size paper
<name> NAME  table1 to table4, or fig5 to fig8
--out DIR = paper  folder of all tables (default paper)
--rows A,B  only these rows, named as in --dry-run or as in the table
--dry-run  print the commands of every cell, run nothing
--table-only  write the table of finished cells, run nothing
[budget]
--people N = 200000  number of people per stage: pre-training, and fine-tuning on the synthesized target
 (default 200000); on a real dataset, fine-tuning takes the recipe's epochs, unless --hours ends it earlier
--hours H  training time per row, all stages: longer trainings are shortened with their schedule
--seeds K = 1  seeds 0 ... K-1 of each cell (default 1)
--workers N = 1  worker processes of each command (default 1)
--size NAME = paper-small  size of all networks: paper-small (default), paper-tiny or paper-deep (five levels),
 reduced; paper: as published
[data]
--data NAME=DIR,...  prepared real datasets for fine-tuning and evaluation: waymo, humanm3, lidarhuman26m, sloper4d;
 for pre-training: lipd, freemotion, noisemotion; raw poses: freemotion-poses, lidarhuman26m-poses;
 smpl=FILE: your SMPL file, the body model for these poses (default: the shipped body)
--motion FILE,FILE  captured motion for synthesis; each is a row of table2, other tables use the first
--subjects A,B  training subjects of the first file
--held-out A,B  held-out subjects of the first file, shown by the synthesized target
"""


def add(commands, execute: Callable[[list[str]], int]) -> None:
    """Adds the command to the parser's. execute: runs another command, see `paper.steps.Execute`."""
    add_command(commands, "paper", partial(_paper, commands, execute), _PAPER)


def _paper(commands, execute: Callable[[list[str]], int], options: argparse.Namespace) -> None:
    from lidarpose.paper import figures
    from lidarpose.paper.cells import Options, cells
    from lidarpose.paper.markdown import plan
    from lidarpose.paper.report import check_targets, run_table, write_table
    from lidarpose.paper.steps import begin_out, check_out
    from lidarpose.paper.tables import TABLES

    check_name("table or figure", options.name, _NAMES)
    if options.name == "fig6" and (options.rows or options.data or options.held_out or options.table_only):
        raise InputError(
            "fig6 shows a synthesized body and has no rows: omit --rows, --data, --held-out and --table-only"
        )
    budget = {name: getattr(options, name) for name in ("people", "hours", "seeds", "workers", "size")}
    budget |= {"subjects": options.subjects or "", "held_out": options.held_out or ""}
    paper_options = Options(data=_data(options.data), motion=names(options.motion or ""), **budget)
    out = Path(options.out)
    check_out(out)
    if options.name == "fig6":
        if options.dry_run:
            print("# Figure 6: synthesized bodies\n\nDrawn at once; there is nothing to train.")
            return
        begin_out(out)
        motion = paper_options.motion[0] if paper_options.motion else None
        subjects = names(options.subjects) if options.subjects else None
        print(figures.draw_one_body(out, motion=motion, subjects=subjects))
        return
    table, row_keys = TABLES[options.name], names(options.rows or "")
    selected_cells = cells(table, paper_options, row_keys)
    if options.dry_run:
        for warning in check_targets(selected_cells):
            tell(warning)
        print(plan(table, selected_cells, out, partial(_problem, commands)), end="")
        return
    if options.table_only:
        begin_out(out)
        content = write_table(table, paper_options, out, chosen=row_keys, update=True)
    else:
        content = run_table(table, paper_options, out, row_keys, execute, tell)
    print(out / f"{table.name}.md")
    # of all rows, as the page: --rows says which to run
    for path in figures.draw(table.name, cells(table, paper_options), out) if table.name.startswith("fig") else ():
        print(path)
    if failed := sum(entry["state"] == "failed" for entry in content["cells"]):
        done = "the others are done where they were asked for"
        raise InputError(f"{counted(failed, 'cell')} failed, {done}: {out / table.name}.md has the reasons")


def _data(text: str | None) -> dict[str, str]:
    """name -> folder of "name=folder,name=folder"."""
    folders = {}
    for part in names(text or ""):
        name, equals, folder = part.partition("=")
        if not equals or not folder:
            raise InputError(f"expected --data NAME=DIR,..., got {part}")
        if name in folders:
            raise InputError(f"expected each name of --data once, got {name} twice: give it one folder")
        folders[name] = folder
    return folders


def _problem(commands, words: list[str]) -> str:
    """What a command's parser says against its words, "" for nothing."""
    errors = io.StringIO()
    try:
        with redirect_stderr(errors):
            commands.choices[words[0]].parse_args(words[1:])
    except SystemExit:
        return errors.getvalue().strip().removeprefix("lidarpose: error: ")
    return ""
