"""Live values: a running DPS is read, watched and set from other processes without delaying its loop.

`service.LiveService` runs in the loop's process, `server.LiveServer` in its worker process; other processes use
`client.LiveClient`, `client.watch` and `client.LiveWatch`.

This module imports nothing: neither the worker process nor the clients need Drake.
"""
