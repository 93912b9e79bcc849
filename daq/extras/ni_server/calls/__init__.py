"""Handlers that execute the remote calls of clients on the instrument; the names of calls are NI's."""
