"""What every job needs, whatever it works on: files written whole, threads, clocks."""
