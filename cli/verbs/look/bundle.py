"""Write the evidence of a failure to one file."""

from functools import partial
from pathlib import Path

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.reader import check_readable
from dora_systemd.cli.parameters import current_scope, print_warnings, scope_options
from dora_systemd.errors import ExitCode, usage_error
from dora_systemd.values import quoted
from dora_systemd.verbs.bundles.write import write_bundle


@click.command("bundle")
@click.argument("selector")
@click.option("-o", "--output", "file", metavar="FILE", help="Write it there.")
@click.option("--no-journal", is_flag=True, help="Leave out everything that nodes have written.")
@click.option("--images", is_flag=True, help="Also write recorded pictures as files.")
@scope_options
def command(selector: str, file: str | None, no_journal: bool, images: bool) -> int:
    """Write a tar file about a dataflow: what `why` says, its journal, unit, nodes and limits.

    It never has values of variables, arguments, settings or credentials. What nodes have written
    to their logs is in it as it is, unless --no-journal is given. Without -o it is kept with the
    bundles that `doractl bundles` lists. Only its owner can read it.

    Examples:
      doractl bundle robot
      doractl bundle robot -o robot.tar --no-journal
      doractl bundle robot --images
      doractl why --bundle robot.tar
    """
    if file is not None and (file in ("", "-") or file.endswith("/")):
        message = f"cannot write a bundle to {quoted(file)}: no path of a file"
        raise usage_error(message, "doractl bundle NAME -o FILE")
    scope = current_scope()
    check_readable(scope)
    place = None if file is None else Path(file).absolute()
    reach = partial(Bus, for_reading=True)
    done = write_bundle(reach, scope, selector, "doractl bundle", place, not no_journal, images)
    print_warnings(f"not in the bundle: {one}" for one in done.errors)
    click.echo(str(done.path))
    return ExitCode.OK
