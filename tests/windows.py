"""A command line on a system that lacks what Windows lacks: ``python windows.py COMMAND …``.

Only endotwin is made to lack it: other libraries have ways of their own there.
"""

import builtins
import os
import signal
import sys

MODULES = ("fcntl", "resource", "termios", "pwd", "grp")
SIGNALS = ("SIGALRM", "SIGHUP", "SIGKILL", "SIGUSR1", "ITIMER_REAL", "setitimer", "pthread_sigmask")
CALLS = ("sched_getaffinity", "set_blocking", "fork", "O_DIRECTORY", "getuid", "geteuid")


def lack_it() -> None:
    """From now on this process is without them."""
    real = builtins.__import__

    def absent(name, caller=None, *rest, **more):
        if name in MODULES and (caller or {}).get("__name__", "").startswith("endotwin"):
            raise ImportError(name)
        return real(name, caller, *rest, **more)

    builtins.__import__ = absent
    for module, names in ((signal, SIGNALS), (os, CALLS)):
        for name in names:
            vars(module).pop(name, None)


lack_it()  # in worker processes too, which run this file again

if __name__ == "__main__":
    from endotwin.cli.start import main

    sys.argv[0] = "endotwin"
    main()
