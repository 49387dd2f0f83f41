/* Notes down what a process writes into a folder: each write, truncation, sync, and change of a
 * name, with its time.  Loaded before libc (LD_PRELOAD); tests/power_cuts.py reads what it notes.
 * CUT_FOLDER is the folder, CUT_RECORD the file of notes. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

enum { WRITE = 1, TRUNCATE = 2, SYNC = 3, NAME = 4, UNNAME = 5, RENAME = 6 };

struct note {
    double t;
    int64_t op, file, offset, length;
};

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static int record = -1;

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void put(double t, int64_t op, int64_t file, int64_t offset, const void *data, size_t length)
{
    struct note note = {t, op, file, offset, (int64_t)length};
    struct iovec parts[2] = {{&note, sizeof note}, {(void *)data, length}};
    pthread_mutex_lock(&lock);
    if (record < 0)
        record = (int)syscall(SYS_openat, AT_FDCWD, getenv("CUT_RECORD"),
                              O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
    if (syscall(SYS_writev, record, parts, 2) != (long)(sizeof note + length))
        abort();
    pthread_mutex_unlock(&lock);
}

static int inside(const char *path)
{
    const char *folder = getenv("CUT_FOLDER");
    return folder != NULL && strncmp(path, folder, strlen(folder)) == 0;
}

/* The number of an open file in the folder, or 0. */
static int64_t number(int handle)
{
    char link[64], path[4096];
    struct stat facts;
    snprintf(link, sizeof link, "/proc/self/fd/%d", handle);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length <= 0)
        return 0;
    path[length] = 0;
    return inside(path) && fstat(handle, &facts) == 0 ? (int64_t)facts.st_ino : 0;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static int opened(int handle, const char *path, int flags)
{
    int64_t file;
    if (handle >= 0 && (flags & O_CREAT) && (file = number(handle)) != 0) {
        put(now(), NAME, file, 0, path, strlen(path) + 1);
        if (flags & O_TRUNC)
            put(now(), TRUNCATE, file, 0, "", 0);
    }
    return handle;
}

#define OPEN(name)                                                                                 \
    int name(const char *path, int flags, ...)                                                     \
    {                                                                                              \
        va_list rest;                                                                              \
        va_start(rest, flags);                                                                     \
        unsigned mode = (flags & O_CREAT) ? va_arg(rest, unsigned) : 0;                            \
        va_end(rest);                                                                              \
        return opened(REAL(name)(path, flags, mode), path, flags);                                 \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                                                               \
    int name(int folder, const char *path, int flags, ...)                                         \
    {                                                                                              \
        va_list rest;                                                                              \
        va_start(rest, flags);                                                                     \
        unsigned mode = (flags & O_CREAT) ? va_arg(rest, unsigned) : 0;                            \
        va_end(rest);                                                                              \
        return opened(REAL(name)(folder, path, flags, mode), path, flags);                         \
    }
OPENAT(openat)
OPENAT(openat64)

ssize_t write(int handle, const void *data, size_t count)
{
    double t = now();
    int64_t file = number(handle), where = file ? lseek(handle, 0, SEEK_CUR) : 0;
    ssize_t done = REAL(write)(handle, data, count);
    if (file && done > 0)
        put(t, WRITE, file, where, data, (size_t)done);
    return done;
}

#define PWRITE(name, offset_t)                                                                     \
    ssize_t name(int handle, const void *data, size_t count, offset_t where)                       \
    {                                                                                              \
        double t = now();                                                                          \
        ssize_t done = REAL(name)(handle, data, count, where);                                     \
        int64_t file = number(handle);                                                             \
        if (file && done > 0)                                                                      \
            put(t, WRITE, file, where, data, (size_t)done);                                        \
        return done;                                                                               \
    }
PWRITE(pwrite, off_t)
PWRITE(pwrite64, off64_t)

#define TRUNC(name, offset_t)                                                                      \
    int name(int handle, offset_t length)                                                          \
    {                                                                                              \
        double t = now();                                                                          \
        int done = REAL(name)(handle, length);                                                     \
        int64_t file = number(handle);                                                             \
        if (file && done == 0)                                                                     \
            put(t, TRUNCATE, file, length, "", 0);                                                 \
        return done;                                                                               \
    }
TRUNC(ftruncate, off_t)
TRUNC(ftruncate64, off64_t)

#define SYNCED(name)                                                                               \
    int name(int handle)                                                                           \
    {                                                                                              \
        int done = REAL(name)(handle);                                                             \
        int64_t file = number(handle);                                                             \
        if (file && done == 0)                                                                     \
            put(now(), SYNC, file, 0, "", 0);                                                      \
        return done;                                                                               \
    }
SYNCED(fsync)
SYNCED(fdatasync)

int unlink(const char *path)
{
    double t = now();
    int done = REAL(unlink)(path);
    if (done == 0 && inside(path))
        put(t, UNNAME, 0, 0, path, strlen(path) + 1);
    return done;
}

int rename(const char *from, const char *to)
{
    char both[8192];
    double t = now();
    int done = REAL(rename)(from, to);
    if (done == 0 && inside(to)) {
        size_t first = strlen(from) + 1, second = strlen(to) + 1;
        memcpy(both, from, first);
        memcpy(both + first, to, second);
        put(t, RENAME, 0, 0, both, first + second);
    }
    return done;
}
