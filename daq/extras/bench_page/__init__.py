"""The page of `daq bench`: live channels, tests on request and recordings.

Start with `bench`. `monitor` and `live_bench` do not depend on the page; `page` does not depend on threads. The scripts
in `browser` draw the data that `page` sends; `application` transfers messages and commands.
"""
