"""What every job needs, whatever it works on: files written whole, worker processes, threads, clocks."""
