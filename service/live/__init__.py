"""The live mission page: what is kept of the newest decisions, the stream of events, and the page itself."""
