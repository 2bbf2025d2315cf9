// SPDX-License-Identifier: GPL-3.0-or-later
// Fault injection for file operations, preloaded into a process and its children on Linux.
//
// Counts calls of one kind (FAULT_CALL: open, write, fsync, rename or unlink) that concern files below one folder
// (FAULT_FOLDER), over all processes together, in a shared file (FAULT_COUNTER) of
// eight bytes for each kind in this order. Call number
// FAULT_NUMBER (from 1; 0 only counts) fails with FAULT_ERRNO, or kills the process where FAULT_ERRNO is "kill".
// With FAULT_STICKY=1 all later calls fail too, as on a disk that stays full. `fault_arm` sets all of them anew in a
// running process, which a fork of a warm process calls.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

#define KINDS 5
static const char *const kinds[KINDS] = {"open", "write", "fsync", "rename", "unlink"};
static _Atomic long *counter;
static long fault_number;
static int fault_errno, sticky;
static char fault_call[16], folder[4096];

void fault_arm(const char *call, long number, const char *error, int stays, const char *below) {
    snprintf(fault_call, sizeof fault_call, "%s", call);
    snprintf(folder, sizeof folder, "%s", below);
    fault_number = number;
    sticky = stays;
    if (!error || !strcmp(error, "EIO")) fault_errno = EIO;
    else if (!strcmp(error, "kill")) fault_errno = -1;
    else if (!strcmp(error, "ENOSPC")) fault_errno = ENOSPC;
    else fault_errno = EACCES;
}

__attribute__((constructor)) static void start(void) {
    const char *path = getenv("FAULT_COUNTER"), *call = getenv("FAULT_CALL"), *below = getenv("FAULT_FOLDER");
    const char *number = getenv("FAULT_NUMBER"), *stays = getenv("FAULT_STICKY");
    if (!path || !call || !below) return;
    int descriptor = (int)syscall(SYS_openat, AT_FDCWD, path, O_RDWR, 0);
    if (descriptor < 0) return;
    void *shared = mmap(NULL, 8 * KINDS, PROT_READ | PROT_WRITE, MAP_SHARED, descriptor, 0);
    syscall(SYS_close, descriptor);
    if (shared == MAP_FAILED) return;
    fault_arm(call, number ? atol(number) : 0, getenv("FAULT_ERRNO"), stays && stays[0] == '1', below);
    counter = shared;
}

// Whether the path lies in the folder; a relative path is resolved against the directory of `at`.
static int concerns(int at, const char *path) {
    if (!counter || !path) return 0;
    char whole[8192];
    if (path[0] != '/') {
        char base[4096], link[64];
        ssize_t length;
        if (at == AT_FDCWD) {
            if (syscall(SYS_getcwd, base, sizeof base) < 0) return 0;
        } else {
            snprintf(link, sizeof link, "/proc/self/fd/%d", at);
            length = syscall(SYS_readlinkat, AT_FDCWD, link, base, sizeof base - 1);
            if (length < 0) return 0;
            base[length] = 0;
        }
        snprintf(whole, sizeof whole, "%s/%s", base, path);
        path = whole;
    }
    size_t length = strlen(folder);
    return !strncmp(path, folder, length) && (path[length] == '/' || path[length] == 0);
}

static int concerns_descriptor(int descriptor) {
    if (!counter || descriptor < 3) return 0;
    char link[64], target[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", descriptor);
    ssize_t length = syscall(SYS_readlinkat, AT_FDCWD, link, target, sizeof target - 1);
    if (length < 0) return 0;
    target[length] = 0;
    return concerns(AT_FDCWD, target);
}

// Counts one call; true if it has to fail, with errno set. Does not return from the call that kills.
static int faulty(const char *call) {
    int kind = 0;
    while (kind < KINDS - 1 && strcmp(call, kinds[kind])) kind++;
    long now = atomic_fetch_add(counter + kind, 1) + 1;
    if (strcmp(call, fault_call)) return 0;
    if (fault_number < 1 || now < fault_number || (now > fault_number && !(sticky && fault_errno > 0))) return 0;
    if (fault_errno < 0) {
        syscall(SYS_kill, syscall(SYS_getpid), SIGKILL);
        for (;;) pause();
    }
    errno = fault_errno;
    return 1;
}

#define REAL(type, name, ...) \
    static type (*real)(__VA_ARGS__); \
    if (!real) real = (type (*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

#define WRITES(flags) (((flags) & O_ACCMODE) != O_RDONLY || ((flags) & O_CREAT))

static int mode_of(int flags, va_list rest) { return flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, int) : 0; }

#define OPEN(symbol) \
    int symbol(const char *path, int flags, ...) { \
        REAL(int, #symbol, const char *, int, ...); \
        va_list rest; va_start(rest, flags); int mode = mode_of(flags, rest); va_end(rest); \
        if (WRITES(flags) && concerns(AT_FDCWD, path) && faulty("open")) return -1; \
        return real(path, flags, mode); \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(symbol) \
    int symbol(int at, const char *path, int flags, ...) { \
        REAL(int, #symbol, int, const char *, int, ...); \
        va_list rest; va_start(rest, flags); int mode = mode_of(flags, rest); va_end(rest); \
        if (WRITES(flags) && concerns(at, path) && faulty("open")) return -1; \
        return real(at, path, flags, mode); \
    }
OPENAT(openat)
OPENAT(openat64)

#define FOPEN(symbol) \
    FILE *symbol(const char *path, const char *mode) { \
        REAL(FILE *, #symbol, const char *, const char *); \
        if ((strpbrk(mode, "wa+")) && concerns(AT_FDCWD, path) && faulty("open")) return NULL; \
        return real(path, mode); \
    }
FOPEN(fopen)
FOPEN(fopen64)

ssize_t write(int descriptor, const void *data, size_t size) {
    REAL(ssize_t, "write", int, const void *, size_t);
    if (concerns_descriptor(descriptor) && faulty("write")) return -1;
    return real(descriptor, data, size);
}

ssize_t writev(int descriptor, const struct iovec *parts, int count) {
    REAL(ssize_t, "writev", int, const struct iovec *, int);
    if (concerns_descriptor(descriptor) && faulty("write")) return -1;
    return real(descriptor, parts, count);
}

ssize_t pwrite64(int descriptor, const void *data, size_t size, off64_t at) {
    REAL(ssize_t, "pwrite64", int, const void *, size_t, off64_t);
    if (concerns_descriptor(descriptor) && faulty("write")) return -1;
    return real(descriptor, data, size, at);
}

ssize_t pwrite(int descriptor, const void *data, size_t size, off_t at) {
    REAL(ssize_t, "pwrite", int, const void *, size_t, off_t);
    if (concerns_descriptor(descriptor) && faulty("write")) return -1;
    return real(descriptor, data, size, at);
}

#define SYNC(symbol) \
    int symbol(int descriptor) { \
        REAL(int, #symbol, int); \
        if (concerns_descriptor(descriptor) && faulty("fsync")) return -1; \
        return real(descriptor); \
    }
SYNC(fsync)
SYNC(fdatasync)

int rename(const char *from, const char *to) {
    REAL(int, "rename", const char *, const char *);
    if (concerns(AT_FDCWD, to) && faulty("rename")) return -1;
    return real(from, to);
}

int renameat(int at, const char *from, int other, const char *to) {
    REAL(int, "renameat", int, const char *, int, const char *);
    if (concerns(other, to) && faulty("rename")) return -1;
    return real(at, from, other, to);
}

int unlink(const char *path) {
    REAL(int, "unlink", const char *);
    if (concerns(AT_FDCWD, path) && faulty("unlink")) return -1;
    return real(path);
}

int unlinkat(int at, const char *path, int flags) {
    REAL(int, "unlinkat", int, const char *, int);
    if (concerns(at, path) && faulty("unlink")) return -1;
    return real(at, path, flags);
}
