#!/bin/sh
# Execute a command with the database password in PGPASSWORD, where every client looks for it. The password comes from a
# secret's file or from the environment, so no address and no command line contains it.
set -eu
if [ -n "${ARMSCAN_STORAGE_PASSWORD_FILE:-}" ]; then
    PGPASSWORD="$(cat "$ARMSCAN_STORAGE_PASSWORD_FILE")"
    export PGPASSWORD
elif [ -n "${ARMSCAN_STORAGE_PASSWORD:-}" ]; then
    export PGPASSWORD="$ARMSCAN_STORAGE_PASSWORD"
fi
exec "$@"
