"""A page in the browser for a case: build it, see it move, sweep it, fit it to logs, take it away.

`document` is the text of a case and its changes, `workspace` what is computed for it, without any
web; `server` hands both to the page in `static`.
"""
