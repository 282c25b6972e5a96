"""The command `python -m armscan.run`: one run, with -m several, with resume=RUN_ID one that was cut off."""

from __future__ import annotations

import os

from armscan.threads import one_a_process

one_a_process()
# Ray reads it when it is imported, which other libraries do where it is installed: it would abort a study that is told
# to end with a trace.
os.environ.setdefault("RAY_DISABLE_FAILURE_SIGNAL_HANDLER", "1")

import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from armscan.errors import InvalidValueError, is_interruption
from armscan.invocation import Invocation
from armscan.jobs import start_job
from armscan.mistakes import CONFIG_MODULE, CONFIG_NAME, mistake_in_one_line, quieten_libraries
from armscan.multirun import INTERRUPTED, Multirun, end_multirun, remove_if_untracked
from armscan.passwords import check_words
from armscan.services import hand_over_local
from armscan.settings import MULTIRUN, PLAN, RESUME, SWEEPS

WANTS_TRACEBACKS = "ARMSCAN_TRACEBACKS"


def run(config: DictConfig) -> None:
    """What Hydra calls: a single run, one job of a multirun, or one worker of a study."""
    if config.get("study") is not None:
        # Deferred, because only studies need Optuna.
        from armscan.sweeps.supervising import run_worker

        hydra_config = HydraConfig.get()
        words = [*hydra_config.overrides.task, *hydra_config.overrides.hydra]
        run_worker(config, words, Path(hydra_config.sweep.dir))
        return
    invocation = Invocation.current()
    if invocation.job is not None:
        start_job(config, invocation, invocation.job)
        return
    made = "" if invocation.choices["data"] == "nifti" else " (phantoms are made when first asked for, four a second)"
    print(f"preparing data={invocation.choices['data']}, agent={invocation.choices['agent']}{made}", flush=True)
    try:
        # Deferred: a mistake on the command line should be answered before torch and the like are loaded.
        from armscan.experiment import run_experiment

        run_experiment(config, invocation)
    except KeyboardInterrupt as error:
        remove_if_untracked(invocation.folder, error)
        raise
    # Answered here: on its way out, Hydra would print lines of its own.
    except Exception as error:
        remove_if_untracked(invocation.folder, error)
        if is_interruption(error):
            raise KeyboardInterrupt from error
        raise_or_exit(error)


def raise_or_exit(error: BaseException) -> NoReturn:
    """Answers a user's mistake in one line and leaves; raises any other error, or all where tracebacks are wanted."""
    line = mistake_in_one_line(error)
    if line is None or os.environ.get(WANTS_TRACEBACKS):
        raise error
    print(f"error: {line}", file=sys.stderr)
    raise SystemExit(2)


def launched(words: Sequence[str]) -> None:
    """Runs the command with Hydra, as if these words had been typed."""
    sys.argv[1:] = words
    hydra.main(version_base="1.3", config_path=f"pkg://{CONFIG_MODULE}", config_name=CONFIG_NAME)(run)()


def _is_repeated(words: list[str]) -> bool:
    """Whether a multirun is to repeat only what has not finished; takes the word that says so away."""
    said = [word for word in words if word.startswith(f"{RESUME}=")]
    for word in said:
        if word.partition("=")[2].lower() != "true":
            option = next(each for each in words if each in MULTIRUN)
            raise InvalidValueError(
                f"{word!r} is for a single run, without {option}; a grid is repeated with {RESUME}=true"
            )
        words.remove(word)
    return bool(said)


def main() -> int:
    """Runs what the command line asks for; returns the exit code."""
    if os.environ.get("HYDRA_FULL_ERROR") == "1":
        os.environ[WANTS_TRACEBACKS] = "1"
    # Hydra raises, so that its errors are answered here and not by Hydra.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    # Whoever ends a run, by Ctrl-C or by kill, finds it closed as killed in the tracking store.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    quieten_libraries()
    # Hydra reads its options only before the first override, and people write them anywhere.
    sys.argv[1:] = sorted(sys.argv[1:], key=lambda word: word not in MULTIRUN)
    try:
        check_words(sys.argv[1:])
        if not {"-h", "--help"} & set(sys.argv):
            hand_over_local()
        if any(word == PLAN or word.startswith(f"{SWEEPS}=") for word in sys.argv[1:]):
            from armscan.sweeps.command import run_study

            return run_study(sys.argv[1:], launched)
        if any(word in MULTIRUN for word in sys.argv[1:]):
            Multirun.is_repeated = _is_repeated(sys.argv)
        if any(word.startswith(f"{RESUME}=") for word in sys.argv[1:]):
            # Before Hydra composes a configuration, and makes a folder: a run that goes on has both.
            from armscan.resume import resume

            resume(sys.argv[1:])
        else:
            launched(sys.argv[1:])
    except BrokenPipeError:
        # Whoever reads what --help prints may stop reading; nothing more can be written, not even on the way out.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (KeyboardInterrupt, Exception) as error:
        # Raised inside compiled code, an interrupt can come out as any other error.
        if is_interruption(error):
            end_multirun(is_interrupted=True)
            print(INTERRUPTED, file=sys.stderr)
            return 130
        end_multirun()
        raise_or_exit(error)
    return end_multirun()


if __name__ == "__main__":
    # The module under its own name: jobs in other processes find their function there.
    from armscan.run import main as run_main

    sys.exit(run_main())
