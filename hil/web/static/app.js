// What makes pages live; every page can be read, and every run be stopped, without it.
