/* Copyright 2026 calib_planner contributors */
/* SPDX-License-Identifier: Apache-2.0 */
/*
 * Loaded before the C library (LD_PRELOAD): what a program asks of the files in one folder, and of the system's
 * clock, goes through here. system_calls.py compiles it and shares `struct control` with it.
 *
 * Calls that change the folder are counted. At the call `kill_at` the process ends as by kill -9, after `torn` bytes
 * of a write; calls from `full_from` to `full_until` fail as on a full disk. Every call that was made is written to
 * the log, so that another program can replay it. The clock is `clock_offset` [ns] ahead; waits until a time of day
 * are shifted back, since the system's own clock is not set.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

struct control {
  int64_t clock_offset, count, kill_at, torn, full_from, full_until, logging, acknowledged;
  char folder[512];
};

enum kind { WRITE = 1, TRUNCATE, SYNC, UNLINK, RENAME, CREATE, NOTE, FOLDER };

static struct control *control;
static int log_file = -1;

#define REAL(name) ((__typeof__(&name))real(#name))
static void *real(const char *name) {
  void *newest = dlvsym(RTLD_NEXT, name, "GLIBC_2.3.2"); /* of some functions the first one that is found is old */
  return newest ? newest : dlsym(RTLD_NEXT, name);
}

__attribute__((constructor)) static void begin(void) {
  const char *shared = getenv("SYSTEM_CALLS_CONTROL"), *log = getenv("SYSTEM_CALLS_LOG");
  if (!shared) return;
  int file = (int)syscall(SYS_openat, AT_FDCWD, shared, O_RDWR | O_CLOEXEC, 0);
  if (file < 0) return;
  void *memory = mmap(NULL, sizeof(struct control), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
  syscall(SYS_close, file);
  if (memory != MAP_FAILED) control = memory;
  if (log) log_file = (int)syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0600);
}

static int inside(const char *path) {
  size_t length = control ? strlen(control->folder) : 0;
  return length && !strncmp(path, control->folder, length) && (path[length] == '/' || !path[length]);
}

static const char *path_of(int file, char *path, size_t size) {
  char link[64];
  if (!control || !control->folder[0]) return NULL;
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, path, size - 1);
  if (length < 0) return NULL;
  path[length] = 0;
  return inside(path) ? path : NULL;
}

static void put(const void *data, size_t size) {
  while (size) {
    long done = syscall(SYS_write, log_file, data, size);
    if (done <= 0) return;
    data = (const char *)data + done;
    size -= (size_t)done;
  }
}

static void note(enum kind kind, const char *path, int64_t offset, const void *data, int64_t size) {
  if (log_file < 0 || !control || !control->logging) return;
  int64_t head[4] = {kind, (int64_t)strlen(path), offset, size};
  put(head, sizeof head);
  put(path, strlen(path));
  if (data) put(data, (size_t)size);
}

/* For the program itself: that it has acknowledged so many steps. */
void system_calls_acknowledge(int64_t steps) {
  if (!control) return;
  control->acknowledged = steps;
  note(NOTE, "", steps, NULL, 0);
}

/* Count a call; ends the process if it is the one, returns whether the disk is full. */
static int counted(int file, const void *data, size_t size, off_t offset) {
  int64_t number = __atomic_add_fetch(&control->count, 1, __ATOMIC_SEQ_CST);
  if (number == control->kill_at) {
    if (data && control->torn > 0) {
      size_t part = size < (size_t)control->torn ? size : (size_t)control->torn;
      if (offset < 0) syscall(SYS_write, file, data, part);
      else syscall(SYS_pwrite64, file, data, part, offset);
    }
    syscall(SYS_kill, getpid(), SIGKILL);
  }
  if (control->full_from && number >= control->full_from && number < control->full_until) {
    errno = ENOSPC;
    return 1;
  }
  return 0;
}

ssize_t write(int file, const void *data, size_t size) {
  char name[600];
  const char *path = path_of(file, name, sizeof name);
  if (path && counted(file, data, size, -1)) return -1;
  struct stat status;
  int64_t at = path ? lseek(file, 0, SEEK_CUR) : 0;
  if (path && (fcntl(file, F_GETFL) & O_APPEND) && !fstat(file, &status)) at = status.st_size;
  ssize_t done = REAL(write)(file, data, size);
  if (path && done > 0) note(WRITE, path, at, data, done);
  return done;
}

ssize_t pwrite64(int file, const void *data, size_t size, off64_t offset) {
  char name[600];
  const char *path = path_of(file, name, sizeof name);
  if (path && counted(file, data, size, offset)) return -1;
  ssize_t done = syscall(SYS_pwrite64, file, data, size, offset);
  if (path && done > 0) note(WRITE, path, offset, data, done);
  return done;
}

ssize_t pwrite(int file, const void *data, size_t size, off_t offset) { return pwrite64(file, data, size, offset); }

int ftruncate64(int file, off64_t size) {
  char name[600];
  const char *path = path_of(file, name, sizeof name);
  if (path && counted(file, NULL, 0, 0)) return -1;
  int done = (int)syscall(SYS_ftruncate, file, size);
  if (path && !done) note(TRUNCATE, path, size, NULL, 0);
  return done;
}

int ftruncate(int file, off_t size) { return ftruncate64(file, size); }

static int synced(int file, int call) {
  char name[600];
  const char *path = path_of(file, name, sizeof name);
  if (path && counted(file, NULL, 0, 0)) return -1;
  if (path) note(SYNC, path, 0, NULL, 0);
  return path ? 0 : (int)syscall(call, file); /* a killed process loses nothing that was written: no need to wait */
}

int fsync(int file) { return synced(file, SYS_fsync); }
int fdatasync(int file) { return synced(file, SYS_fdatasync); }

int unlink(const char *path) {
  if (inside(path) && counted(-1, NULL, 0, 0)) return -1;
  int done = REAL(unlink)(path);
  if (!done && inside(path)) note(UNLINK, path, 0, NULL, 0);
  return done;
}

int rename(const char *path, const char *to) {
  if (inside(path) && counted(-1, NULL, 0, 0)) return -1;
  int done = REAL(rename)(path, to);
  if (!done && inside(path)) note(RENAME, path, 0, to, (int64_t)strlen(to));
  return done;
}

int mkdir(const char *path, mode_t mode) {
  if (inside(path) && counted(-1, NULL, 0, 0)) return -1;
  int done = REAL(mkdir)(path, mode);
  if (!done && inside(path)) note(FOLDER, path, 0, NULL, 0);
  return done;
}

static int opened(int folder, const char *path, int flags, mode_t mode) {
  int makes = (flags & O_CREAT) && inside(path) && access(path, F_OK);
  if (makes && counted(-1, NULL, 0, 0)) return -1;
  int file = (int)syscall(SYS_openat, folder, path, flags, mode);
  if (makes && file >= 0) note(CREATE, path, 0, NULL, 0);
  if (!makes && file >= 0 && (flags & O_TRUNC) && inside(path)) note(TRUNCATE, path, 0, NULL, 0);
  return file;
}

#define MODE(flags, mode) \
  mode_t mode = 0;        \
  if ((flags) & O_CREAT) { \
    va_list rest;          \
    va_start(rest, flags); \
    mode = va_arg(rest, mode_t); \
    va_end(rest);          \
  }

int open(const char *path, int flags, ...) { MODE(flags, mode) return opened(AT_FDCWD, path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE(flags, mode) return opened(AT_FDCWD, path, flags, mode); }
int openat(int at, const char *path, int flags, ...) { MODE(flags, mode) return opened(at, path, flags, mode); }
int openat64(int at, const char *path, int flags, ...) { MODE(flags, mode) return opened(at, path, flags, mode); }

/* ── the clock ── */

#define SECOND 1000000000LL

int clock_gettime(clockid_t id, struct timespec *now) {
  if (id != CLOCK_REALTIME || !control || !control->clock_offset) return REAL(clock_gettime)(id, now);
  int done = (int)syscall(SYS_clock_gettime, id, now);
  int64_t ns = now->tv_sec * SECOND + now->tv_nsec + control->clock_offset;
  now->tv_sec = ns / SECOND;
  now->tv_nsec = ns % SECOND;
  return done;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
  struct timespec t;
  (void)zone;
  clock_gettime(CLOCK_REALTIME, &t);
  now->tv_sec = t.tv_sec;
  now->tv_usec = t.tv_nsec / 1000;
  return 0;
}

time_t time(time_t *out) {
  struct timespec t;
  clock_gettime(CLOCK_REALTIME, &t);
  if (out) *out = t.tv_sec;
  return t.tv_sec;
}

/* A time of day is later than a time since the system started. */
static struct timespec back(const struct timespec *until) {
  struct timespec t = *until;
  if (control && control->clock_offset && t.tv_sec > 1000000000) {
    int64_t ns = t.tv_sec * SECOND + t.tv_nsec - control->clock_offset;
    t.tv_sec = ns / SECOND;
    t.tv_nsec = ns % SECOND;
  }
  return t;
}

int pthread_cond_timedwait(pthread_cond_t *c, pthread_mutex_t *m, const struct timespec *until) {
  struct timespec t = back(until);
  return REAL(pthread_cond_timedwait)(c, m, &t);
}
