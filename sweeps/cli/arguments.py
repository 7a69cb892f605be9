"""Arguments that several commands share."""

from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperOption


class Command(TyperCommand):
    """A command that refuses an option of one value given twice, and says which may be repeated."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """The arguments of `args`; typer alone would take an option's last value without a word."""
        _, extra, order = self.make_parser(ctx).parse_args(args=list(args))
        options = [param for param in self.params if isinstance(param, TyperOption)]
        for option in options:
            if order.count(option) > 1 and not (option.multiple or option.is_flag):
                ctx.fail(f"{option.opts[0]} takes one value, but is given {order.count(option)}")
        if extra:
            several = [f"{option.opts[0]} {extra[0]}" for option in options if option.multiple]
            write = f"; write {' or '.join(several)} for one more value" if several else ""
            ctx.fail(f"unexpected argument {' '.join(extra)}{write}")
        return super().parse_args(ctx, args)


def folder(typed: str) -> Path:
    """A folder to write into. Raises SweepError as `place` does."""
    return _places().place(typed)


def store(typed: str) -> Path:
    """The place of a store. Raises SweepError as `place_of_store` does."""
    return _places().place_of_store(typed)


def new(typed: str) -> Path:
    """The place of a new file or store. Raises SweepError as `place_of_new` does."""
    return _places().place_of_new(typed)


def _places() -> ModuleType:
    """The module `place`, which imports JAX. Its ValueError would look like one of the argument."""
    try:
        from sweeps.store import place
    except ValueError as error:
        raise ImportError(str(error)) from error
    return place


SweepName = Annotated[str, typer.Argument(metavar="NAME|FILE", help="library name or TOML file")]
StorePath = Annotated[Path, typer.Argument(parser=store, metavar="PATH", help="a result store")]
NewStore = Annotated[
    Path | None, typer.Option(parser=new, metavar="PATH", help="the store to write")
]
NewFile = Annotated[Path | None, typer.Option(parser=new, metavar="FILE", help="the file to write")]
