/* The desk robot: what robot.c does with a board's pins. */
#ifndef ROBOT_H
#define ROBOT_H

#include <ztl_node.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Its components: a stage and a lamp. */
#define ROBOT_COMPONENTS 2
extern const ztl_component robot_components[ROBOT_COMPONENTS];

/* The board provides them: where the stage is to be, in tenths of a millimetre; and whether the lamp is lit. */
void board_place(int tenths);
void board_lamp(int on);

#ifdef __cplusplus
}
#endif

#endif
