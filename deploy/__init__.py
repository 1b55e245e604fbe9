"""The Go2 over its own wire: messages, DDS transport, and what a controller process needs of them."""
