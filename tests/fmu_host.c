/* A program that is no Python and runs a unit for FMI 2.0: host LIBRARY RESOURCES GUID
   It sets four inputs, takes steps of 20 s, and prints two outputs after each. */
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>

typedef void *(*Instantiate)(const char *, int, const char *, const char *, const void *, int, int);
typedef int (*Setup)(void *, int, double, double, int, double);
typedef int (*Plain)(void *);
typedef void (*Free)(void *);
typedef int (*Set)(void *, const unsigned *, size_t, const double *);
typedef int (*Get)(void *, const unsigned *, size_t, double *);
typedef int (*Step)(void *, double, double, int);

static void logger(void *env, const char *name, int status, const char *kind, const char *text, ...) {
    fprintf(stderr, "%s\n", text);
}

static struct {
    void *logger, *allocate, *release, *finished, *environment;
} callbacks = {(void *)logger, (void *)calloc, (void *)free, NULL, NULL};

int main(int argc, char **argv) {
    void *library = dlopen(argv[1], RTLD_LAZY);
    if (argc != 4 || library == NULL) {
        fprintf(stderr, "%s\n", dlerror());
        return 1;
    }
    void *unit = ((Instantiate)dlsym(library, "fmi2Instantiate"))("unit", 1, argv[3], argv[2], &callbacks, 0, 1);
    if (unit == NULL) return 2;
    ((Setup)dlsym(library, "fmi2SetupExperiment"))(unit, 0, 0.0, 0.0, 0, 0.0);
    ((Plain)dlsym(library, "fmi2EnterInitializationMode"))(unit);
    ((Plain)dlsym(library, "fmi2ExitInitializationMode"))(unit);
    const unsigned inputs[4] = {0, 1, 2, 3}, outputs[2] = {5, 6};
    for (int k = 0; k < 10; k++) {
        double values[4] = {20.0 + k, 20.0 + 0.1 * k, 20.0, 20.0}, found[2];
        ((Set)dlsym(library, "fmi2SetReal"))(unit, inputs, 4, values);
        if (((Step)dlsym(library, "fmi2DoStep"))(unit, 20.0 * k, 20.0, 1) != 0) return 3;
        ((Get)dlsym(library, "fmi2GetReal"))(unit, outputs, 2, found);
        printf("%.17g %.17g\n", found[0], found[1]);
    }
    ((Plain)dlsym(library, "fmi2Terminate"))(unit);
    ((Free)dlsym(library, "fmi2FreeInstance"))(unit);
    return 0;
}
