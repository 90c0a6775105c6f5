"""What the system gives: files whole or not at all, folders of users, child processes, JSON and YAML read into
dataclasses, a cache of recent things, words that can be read on every terminal."""
