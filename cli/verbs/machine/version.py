"""Print the versions of doractl, Python, systemd and dora."""

import click

from dora_systemd.cli.parameters import current_scope, output_option, print_json, scope_options
from dora_systemd.verbs.version import read_versions


@click.command("version")
@output_option
@scope_options
def command(output: str) -> None:
    """Print the versions of doractl, Python, systemd and dora.

    Examples:
      doractl version
      doractl version -o json
    """
    versions = read_versions(current_scope())
    if output == "json":
        print_json(versions)
        return
    for name, version in versions.items():
        click.echo(f"{name:<8} {version or 'not found'}")
