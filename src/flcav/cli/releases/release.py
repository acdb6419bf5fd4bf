"""`flcav release`: candidates, their verification, signatures of provider and customer, roll-out and roll-back."""

from importlib.util import find_spec

import typer

from flcav.cli.releases import candidates, repositories, rollouts
from flcav.config import InputError
from flcav.interface.wording import format_install_command

release = typer.Typer(
    help="Releases: verify a network, let provider and customer acknowledge it, roll it out.", no_args_is_help=True
)
for command in (
    repositories.init,
    candidates.propose,
    candidates.verify,
    repositories.sign,
    repositories.publish,
    repositories.install,
    repositories.equip,
    rollouts.shadow,
    rollouts.rollout,
    rollouts.deliver,
    rollouts.rehearse,
    rollouts.rollback,
    repositories.status,
):
    release.command()(command)


@release.callback()
def _group() -> None:
    if missing := [name for name in ("tuf", "model_signing") if find_spec(name) is None]:
        raise InputError(f"releases need {missing[0]}, which is in: {format_install_command('releases')}")
