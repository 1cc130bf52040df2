"""The stack of docker-compose.yml, driven by `docker` and Compose."""
