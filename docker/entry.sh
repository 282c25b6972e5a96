#!/bin/sh
# Becomes the command that it is given, which then has the password of the database where every client looks for it: from
# the file of a secret, or from the environment. So it stands in no address and in no command line.
set -eu
if [ -n "${ARMSCAN_STORAGE_PASSWORD_FILE:-}" ]; then
    PGPASSWORD="$(cat "$ARMSCAN_STORAGE_PASSWORD_FILE")"
    export PGPASSWORD
elif [ -n "${ARMSCAN_STORAGE_PASSWORD:-}" ]; then
    export PGPASSWORD="$ARMSCAN_STORAGE_PASSWORD"
fi
exec "$@"
