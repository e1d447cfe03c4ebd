"""`vical completion SHELL`: completion as fixed text for the shell, so that a press of TAB starts no Python.

The words come from the parsers of the commands; what lies on the disk (ports, cameras, target files,
recordings) is looked up by the shell itself.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from importlib import import_module

from vical_daemon.cli import options, table
from vical_daemon.cli.options import add_json

SHELLS = ("bash", "zsh")

_EPILOG = """\
examples:
  echo 'source <(vical completion bash)' >> ~/.bashrc
  echo 'source <(vical completion zsh)' >> ~/.zshrc          after compinit
"""

_BY_METAVAR = {
    "LOG": "logs",
    "INPUT": "logs",
    "SOURCE": "results",
    "DEVICE": "cameras",
    "PORT": "ports",
    "ROLE": "roles",
    "DIR": "files",
    "FILE": "files",
}
_BY_OPTION = {"--target": "targets", "--from": "targets", "--config": "configs", "--initial": "configs"}
_NUMBERS = ("--web", "--foxglove")  # their PORT is one of TCP

_ZSH = """\
autoload -U +X bashcompinit && bashcompinit
"""
_SCRIPT = r"""# Completion of vical, made by `vical completion SHELL`. Source it.
@prelude@
_vical_words() {
  local word
  for word in $1; do
    case "$word" in "$cur"*) COMPREPLY+=("$word") ;; esac
  done
}
# Folders, and files with one of the given endings; without any, all files.
_vical_files() {
  local item ending
  type compopt >/dev/null 2>&1 && compopt -o filenames 2>/dev/null
  for item in "$cur"*; do
    [ -e "$item" ] || continue
    if [ -d "$item" ] || [ "$#" -eq 0 ]; then COMPREPLY+=("$item"); continue; fi
    for ending in "$@"; do
      case "$item" in *"$ending") COMPREPLY+=("$item"); break ;; esac
    done
  done
}
_vical_targets() {
  local item
  local -a found
  _vical_files .yaml .yml
  found=("${COMPREPLY[@]}")
  COMPREPLY=()
  for item in "${found[@]}"; do
    if [ -d "$item" ] || grep -qs '^target_type' "$item"; then COMPREPLY+=("$item"); fi
  done
}
_vical_devices() {
  local item
  for item in "$@"; do
    if [ -e "$item" ]; then _vical_words "$item"; fi
  done
}
_vical_complete() {
  case "$1" in
    logs) _vical_files .mcap .mcap.part .bag .db3 .csv ;;
    results) _vical_files .json .mcap .yaml; [ -n "$cur" ] || COMPREPLY+=(store) ;;
    targets) _vical_targets ;;
    configs) _vical_files .yaml .yml ;;
    files) _vical_files ;;
    ports) _vical_devices /dev/serial/by-id/* /dev/vical/* /dev/ttyUSB* /dev/ttyACM* ;;
    cameras) _vical_devices /dev/v4l/by-id/* /dev/video[0-9]* ;;
    roles) _vical_words "@roles@" ;;
    =*) _vical_words "${1#=}" ;;
  esac
}
_vical() {
  @emulate@local cur prev word number=1 name="" sub="" flags="" place="" value=""
  cur="${COMP_WORDS[COMP_CWORD]}"
  prev="${COMP_WORDS[COMP_CWORD-1]}"
  COMPREPLY=()
  while [ "$number" -lt "$COMP_CWORD" ]; do
    word="${COMP_WORDS[number]}"
    number=$((number + 1))
    case "$word" in -*) continue ;; esac
    if [ -z "$name" ]; then name="$word"; elif [ -z "$sub" ]; then sub="$word"; fi
  done
  case "$name" in
    "") place="=@commands@"; flags="--help --version" ;;
@groups@
    *) sub="" ;;
  esac
  case "$name $sub" in
@leaves@
  esac
  case "$name $sub $prev" in
@values@
  esac
  if [ -n "$value" ]; then _vical_complete "$value"; return; fi
  case "$cur" in
    -*) _vical_words "$flags" ;;
    *) _vical_complete "$place" ;;
  esac
}
complete -F _vical vical
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the shell."""
    parser.epilog = _EPILOG
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help=" or ".join(SHELLS))
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    text = script(args.shell)
    sys.stdout.write(json.dumps({"shell": args.shell, "script": text}) + "\n" if args.json else text)
    return 0


def script(shell: str) -> str:
    """Return the script for a shell of `SHELLS`."""
    groups, leaves, values = [], [], []
    for name, command in table.available().items():
        for sub, parser in _leaves(command):
            if sub:
                groups.append((name, sub))
            flags, place = _of_leaf(parser)
            leaves.append(f'    "{name} {sub}") flags="{" ".join(flags)}"; place="{place}" ;;')
            for options_of_one, kind in _with_values(parser):
                pattern = " | ".join(f'"{name} {sub} {option}"' for option in options_of_one)
                values.append(f'    {pattern}) value="{kind}" ;;')
    subs = {name: " ".join(sub for other, sub in groups if other == name) for name, _ in groups}
    cases = [f'    {name}) [ -n "$sub" ] || place="={words}" ;;' for name, words in subs.items()]
    parts = {
        "prelude": _ZSH if shell == "zsh" else "",
        "emulate": "emulate -L ksh\n  " if shell == "zsh" else "",
        "roles": " ".join(_roles()),
        "commands": " ".join(table.available()),
        "groups": "\n".join(cases),
        "leaves": "\n".join(leaves),
        "values": "\n".join(values),
    }
    text = _SCRIPT
    for mark, part in parts.items():
        text = text.replace(f"@{mark}@", part)
    return text


def _leaves(command: table.Command) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Name of the subcommand (empty: none) and parser of each leaf of a command."""
    parser = options.VicalParser(prog=f"vical {command.name}")
    import_module(command.module).add_arguments(parser)
    for leaf in options.leaves(parser):
        options.add_json(leaf)
        options.add_verbosity(leaf)
        yield leaf.prog.removeprefix(f"vical {command.name}").strip(), leaf


def _of_leaf(parser: argparse.ArgumentParser) -> tuple[list[str], str]:
    """Long options of a leaf, and what its positional arguments are."""
    shown = [action for action in parser._actions if action.help != argparse.SUPPRESS]
    flags = [name for action in shown for name in action.option_strings if name.startswith("--")]
    kinds = [_kind(action) for action in shown if not action.option_strings]
    return flags, next((kind for kind in kinds if kind != "nothing"), "")


def _with_values(parser: argparse.ArgumentParser) -> Iterator[tuple[list[str], str]]:
    """Options that take a value, and what it is."""
    for action in parser._actions:
        if action.option_strings and action.nargs != 0:
            yield list(action.option_strings), _kind(action)


def _kind(action: argparse.Action) -> str:
    """What the value of an argument is, in the words of the script."""
    for name in action.option_strings:
        if name in _BY_OPTION and not action.choices:
            return _BY_OPTION[name]
    if action.choices:
        return "=" + " ".join(map(str, action.choices))
    metavar = action.metavar if isinstance(action.metavar, str) else ""
    if metavar in _BY_METAVAR and not set(action.option_strings) & set(_NUMBERS):
        return _BY_METAVAR[metavar]
    return "files" if metavar.startswith("F.") else "nothing"


def _roles() -> list[str]:
    from vical_daemon.cli.process_sets import PROCESSES

    return list(dict.fromkeys([*PROCESSES, *(role for roles in PROCESSES.values() for role in roles)]))
