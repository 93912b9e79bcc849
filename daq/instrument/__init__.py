"""The device: modules on one clock, tasks as data, engines that run them; it knows no client and no network."""
