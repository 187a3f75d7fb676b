"""`python -m app`: the place where errors become exit codes.

0 success; 1 a failed check or a defect of this program; 2 wrong input, settings or machine; 130
Ctrl-C. Written in the syntax of any Python, so that an old one gets a sentence and no traceback.
"""

import errno
import os
import subprocess
import sys

OLDEST_PYTHON = (3, 11)
OWN_PACKAGES = ("app", "pipelines", "viz")


def check_python(version=sys.version_info):
    """Leave with one sentence where this Python is too old to parse the rest."""
    if tuple(version[:2]) >= OLDEST_PYTHON:
        return
    newer = [name for name in ("python3.13", "python3.12", "python3.11") if _runs(name)]
    advice = "start it with '%s -m app'" % newer[0] if newer else "install Python 3.11 or newer"
    sys.stderr.write(
        "DyOb-SLAM needs Python %d.%d or newer, and this is Python %d.%d: %s.\n"
        % (OLDEST_PYTHON + tuple(version[:2]) + (advice,))
    )
    sys.exit(2)


def _runs(name):
    try:
        with open(os.devnull, "w") as nothing:
            return subprocess.call([name, "-c", ""], stderr=nothing) == 0
    except OSError:
        return False


def main(argv):
    """Run the command line; the exit code."""
    # Matrices here are small: threads of BLAS would only spin beside the two of a run
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from app import cli
    from pipelines.errors import DyObError

    try:
        return cli.main(argv)
    except KeyboardInterrupt:
        return _fail("stopped by Ctrl-C", 130, argv)
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except DyObError as error:
        return _fail(str(error), 2, argv)
    except Exception as error:
        sentence = _fault_of_the_machine(error)
        return _fail(sentence, 2, argv) if sentence else _fail(_defect(error), 1, argv)


def _fault_of_the_machine(error):
    """A sentence for an error that nobody can mend in the code, else None."""
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        where = " (%s)" % error.filename if error.filename else ""
        return "the disk is full%s: make room and start again" % where
    if isinstance(error, OSError) and error.errno in (errno.EACCES, errno.EROFS):
        return "no permission to use %s: choose another place" % (error.filename or "a file")
    if isinstance(error, MemoryError):
        return "the memory is full: close other programs, or use fewer or smaller frames"
    if isinstance(error, ModuleNotFoundError) and error.name.split(".")[0] not in OWN_PACKAGES:
        return (
            "the Python package '%s' is missing: unset DYOB_NO_SETUP so that the set-up brings it, "
            "or install the packages of environment.txt" % error.name
        )
    return None


def _defect(error):
    return (
        "this is a defect of DyOb-SLAM: %s: %s (please report it, with the traceback that --debug "
        "prints and the output of 'python3 -m app doctor')" % (type(error).__name__, error)
    )


def _fail(sentence, code, argv):
    if "--debug" in argv:
        import traceback

        traceback.print_exc()
    sys.stderr.write("dyob-slam: %s\n" % sentence)
    return code


if __name__ == "__main__":
    check_python()
    sys.exit(main(sys.argv[1:]))
