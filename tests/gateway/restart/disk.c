/* Put before libc (LD_PRELOAD), it makes a disk of a test's own for the file named by DISK_FILE:
 * writes wait while the file DISK_STALLS exists, and DISK_SYNCED is told how many bytes of the file are
 * on the disk, which is what a power cut leaves. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

static int is_file(int fd) {
    const char *wanted = getenv("DISK_FILE");
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t len = readlink(link, path, sizeof path - 1);
    if (wanted == NULL || len < 0)
        return 0;
    path[len] = '\0';
    return strcmp(path, wanted) == 0;
}

ssize_t write(int fd, const void *bytes, size_t len) {
    const char *stalls = getenv("DISK_STALLS");
    while (stalls != NULL && is_file(fd) && access(stalls, F_OK) == 0)
        usleep(5000);
    return syscall(SYS_write, fd, bytes, len);
}

static void note_synced(int fd) {
    const char *synced = getenv("DISK_SYNCED");
    struct stat file;
    if (synced == NULL || !is_file(fd) || fstat(fd, &file) != 0)
        return;
    int to = open(synced, O_WRONLY | O_CREAT | O_TRUNC, 0600);
    dprintf(to, "%lld", (long long)file.st_size);
    close(to);
}

int fdatasync(int fd) {
    int done = (int)syscall(SYS_fdatasync, fd);
    note_synced(fd);
    return done;
}

int fsync(int fd) {
    int done = (int)syscall(SYS_fsync, fd);
    note_synced(fd);
    return done;
}
