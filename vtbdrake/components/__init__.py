"""Systems to build testbeds from."""
