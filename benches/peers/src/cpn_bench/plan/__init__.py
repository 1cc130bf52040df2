"""Plans of the planning methods, as a library makes them and as a service serves them."""
