"""List bundles, or remove some."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.listing import print_table
from dora_systemd.cli.parameters import current_scope, output_option, print_json, scope_options
from dora_systemd.decisions.bundles.table import bundle_object, format_bundles
from dora_systemd.errors import usage_error
from dora_systemd.verbs.bundles.listing import (
    find_name,
    kept_names,
    read_bundles,
    remove_bundles,
)


@click.command("bundles")
@click.argument("selector", required=False)
@click.option("--remove", "bundle", metavar="BUNDLE", multiple=True, help="Remove this one.")
@output_option
@scope_options
def command(selector: str | None, bundle: tuple[str, ...], output: str) -> None:
    """List the bundles of all dataflows, or of one, newest first; with --remove, remove some.

    Examples:
      doractl bundles
      doractl bundles robot -o json
      doractl bundles robot --remove robot-20261127T041500Z-requested.tar
    """
    scope = current_scope()
    if bundle:
        _remove(selector, bundle)
        return
    names = kept_names(scope)
    if selector is not None:
        names = [find_name(Bus(scope, for_reading=True), scope, selector)]
    rows = read_bundles(scope, names)
    if output == "json":
        print_json(list(map(bundle_object, rows)))
    elif rows:
        print_table(lambda width, colors: format_bundles(rows, width, colors))
    else:
        click.echo("No bundle.")


def _remove(selector: str | None, bundles: tuple[str, ...]) -> None:
    if selector is None:
        hint = "doractl bundles NAME --remove BUNDLE"
        raise usage_error("--remove needs the name of a dataflow", hint)
    scope = current_scope()
    name = find_name(Bus(scope, for_reading=True), scope, selector)
    for one in remove_bundles(scope, name, bundles):
        click.echo(f"Bundle removed: {one} ({name})")
