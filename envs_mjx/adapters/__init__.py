"""Between this project's environments and those of other libraries. Each module needs its library, and only it."""
