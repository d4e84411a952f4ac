"""Serial ports and TCP connections are opened and read here, and the hub behind each is started."""
