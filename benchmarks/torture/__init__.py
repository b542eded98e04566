"""Does the package keep its promises under hostile users, damaged files, full disks and crashes? One file a promise."""
