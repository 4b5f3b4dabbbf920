"""A page in the browser for a case: build it, see it move, sweep it, fit it to logs, take it away.

`workspace` has the text of a case, its changes and what is computed for it, without any
web; `server` hands both to the page in `static`.
"""
