"""A running DPS, seen and set from other processes, without holding up its loop: `service.LiveService` in the loop's
process, `desk` in its worker process; `client.LiveClient`, `client.watch` and `live_watch.LiveWatch` elsewhere.

Nothing is imported here: neither the worker process nor those who watch need Drake.
"""
