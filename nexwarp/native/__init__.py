"""C++ snippets that Warp has no function for."""
