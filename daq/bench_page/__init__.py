"""The bench as a page in the browser: channels live, tests on request, recordings; the work of `daq bench`.

Start with `bench`. `monitor` and `operator` know no page, `page` no threads.
"""
