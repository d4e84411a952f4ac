"""Serial ports and TCP connections: opened, read, and the conversation with the hub behind each."""
