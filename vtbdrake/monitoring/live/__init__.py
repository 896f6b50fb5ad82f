"""A running DPS, seen and set from other processes, without holding up its loop: `service.LiveService` in the loop's
process, `desk` in its companion; `client.LiveClient`, `client.watch` and `live_watch.LiveWatch` elsewhere.

Nothing is imported here: neither the companion nor those who watch need Drake.
"""
