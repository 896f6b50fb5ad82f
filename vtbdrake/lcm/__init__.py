"""LCM: the bridge between a testbed and a real machine, the codecs of its messages, and a hub for tcpq."""
